"""Runs a protocol on a rig: configuration, steps, engine, procedures, and the operator's screens."""
