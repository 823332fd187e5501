"""The loop closed: recover presses from their images, press them again, compare."""
