"""Comparing images: the fields strokes lie on, CSIM and SSIM, statistics, and the numbers of the paper."""
