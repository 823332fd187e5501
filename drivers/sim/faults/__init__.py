"""Faults of the loopback rig on a script: what may go wrong (`kinds`), when (`phases`), and for how long (`board`).

What a run makes of each fault in each phase stands in the table of docs/faults.md, "Ten faults in ten phases";
tests/collect/faults/test_matrix.py holds the rig to it.
"""
