"""Scripted faults of the loopback rig: what may go wrong (`kinds`), when (`phases`), and for how long (`board`).

What a run does about each fault in each phase is in the table of docs/faults.md, "Ten faults in ten phases";
tests/collect/faults/test_matrix.py checks it.
"""
