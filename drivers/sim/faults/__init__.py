"""Faults of the loopback rig on a script: what may go wrong, when, and for how long."""
