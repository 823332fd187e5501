"""Hardware behind small protocols (`devices`): one folder per device, and the loopback rig in `sim`.

Only `collect` and the front door drive devices. Nothing here imports another folder of the project.
"""
