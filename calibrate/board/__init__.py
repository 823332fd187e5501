"""The camera, measured by a board: corners, lens, plane of the paper, drift.

Used by the calibration, the engine's photographs and the first day; takes pictures as arrays, and touches no device.
"""
