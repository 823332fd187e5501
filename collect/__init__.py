"""Runs a protocol on a rig: configuration, steps, engine, procedures, and the operator's screens.

Reached from the front door alone, and the only folder that drives devices; `start` is where a run begins.
"""
