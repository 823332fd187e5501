"""Hardware: one folder per device, what all of them take and give in `devices`, and the loopback rig in `sim`.

Only `collect` and the front door drive devices. Nothing here imports another folder of the project.
"""
