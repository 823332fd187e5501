"""Force sensors between flange and brush, each on a CAN bus of its own; never the arm's internal bus.

Used by `collect.rig.devices` and `collect.commission`; `simulator` by the loopback rig and tests alone.
"""
