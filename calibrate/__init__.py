"""Turns captures into numbers: scale, preprocessing, similarity, validation, report.

`collect` and the commands call it; it may touch recordings and the folders of sessions, never a device.
"""
