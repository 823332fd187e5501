"""Turns captures into numbers: scale, preprocessing, similarity, validation, report.

`collect` and the commands call it; it may touch recordings and the folders of sessions, never a device.
"""

MM_PER_PX = 0.3
"""Scale of the 128 x 128 field of a press, wherever one is shown, fitted, compared or inverted.

38.4 mm hold an anchored stroke of any cell of the grid; 0.2 mm/px would not.
"""
