"""The rig: its configuration, its devices, the paper on its table, and a check that every device answers."""
