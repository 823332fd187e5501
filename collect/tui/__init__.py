"""The operator's screens: start, set-up, run, questions, review; only this folder imports textual.

Opened by `collect.start` and `collect.cli`. A screen reads snapshots and sends requests; it talks to no device.
"""
