"""Removal of uneven lighting: reflectance relative to the surrounding paper."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np

from calibrate.stroke.params import PX_PER_MM, Floats, Gray, Params, Soft

LIGHT_ROUNDS = 5
PAPER_ABOVE = 0.85
"""Share of the fitted light above which a pixel counts as paper."""


def flatten(raster: Gray, params: Params) -> Soft:
    """Return reflectance relative to the surrounding paper: 1 is paper under any lighting."""
    # At an eighth of the size: the light is smooth, and a window of 32 mm is 640 px at full size.
    shrink = 8
    small = cv2.resize(raster, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
    # Remove the gradient first: closing alone would mistake its dark end for a stroke at the edge.
    slope = light_surface(cast("Gray", small))
    level = (cv2.medianBlur(small, 5) / slope).astype(np.float32)
    side = round(params.background_mm * PX_PER_MM / shrink) | 1
    # Closing fills whatever is darker than its surroundings and thinner than the window.
    kernel = np.ones((side, side), np.uint8)
    closed = cv2.morphologyEx(level, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REPLICATE)
    smooth = cv2.GaussianBlur(closed, (0, 0), side / 8.0) * slope
    height, width = raster.shape
    paper = cv2.resize(smooth.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return cast("Soft", raster.astype(np.float32) / np.maximum(paper, 1.0))


def light_surface(small: Gray) -> Floats:
    """Fit a quadratic surface to the paper, (h, w), at least 1; pixels well below it are ink and are left out."""
    height, width = small.shape
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    values = small.astype(np.float64).ravel()
    paper = np.ones(values.size, np.bool_)
    surface = values
    for _ in range(LIGHT_ROUNDS):
        # Normal equations: six columns of order 1 are well conditioned, and a tall solve would start BLAS threads.
        kept = basis[paper]
        coefficients, *_rest = np.linalg.lstsq(kept.T @ kept, kept.T @ values[paper], rcond=None)
        surface = np.maximum(basis @ coefficients, 1.0)
        paper = values > PAPER_ABOVE * surface
        if np.count_nonzero(paper) < 6 * basis.shape[1]:
            return np.full(small.shape, max(float(np.median(values)), 1.0))
    return surface.reshape(small.shape)
