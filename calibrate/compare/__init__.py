"""Comparing images of strokes: the field they lie on, CSIM and SSIM, statistics, and the numbers of the paper."""

MM_PER_PX = 0.3
"""Scale of the 128 x 128 field of a press, wherever one is shown, fitted, compared or inverted.

38.4 mm hold an anchored stroke of any cell of the grid; 0.2 mm/px would not. Defined here so that commands can name it
as a default without loading anything.
"""
