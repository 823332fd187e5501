"""Rasters: outlines to images of exact coverage, compiled for speed, or in torch with gradients."""
