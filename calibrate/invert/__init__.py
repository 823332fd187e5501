"""Depth and tilt recovered from photographs of presses."""
