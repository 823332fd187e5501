"""How alike two images of ink are: CSIM, SSIM and IoU.

Ink is 1 and paper 0: with paper as 1, a blank page would score .94.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]
Floats = NDArray[np.float64]

SSIM_SIGMA, SSIM_RADIUS = 1.5, 5
C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for images from 0 to 1."""
SSIM_SETTINGS = (
    f"scikit-image structural_similarity, data_range 1, gaussian weights, sigma {SSIM_SIGMA}, population covariance"
)


def csim(a: Image, b: Image) -> float:
    """Cosine similarity of two (h, w) images with values in [0, 1]. Raises ValueError if one is blank."""
    _check(a, b)
    x, y = a.astype(np.float64), b.astype(np.float64)
    # Not by BLAS, whose threads wait for each other when many images are compared at once.
    norm = float(np.sqrt((x * x).sum() * (y * y).sum()))
    if norm == 0.0:
        raise ValueError("cosine similarity is not defined for a blank image")
    return float((x * y).sum()) / norm


def binary_scores(seen: NDArray[np.bool_], truth: NDArray[np.bool_]) -> Floats:
    """(n, 2) CSIM and IoU of n pairs of (h, w) images of ink or paper; 0 where either is blank."""
    seen, truth = seen.reshape(len(seen), -1), truth.reshape(len(truth), -1)
    both = np.count_nonzero(seen & truth, axis=1).astype(np.float64)
    one, other = np.count_nonzero(seen, axis=1), np.count_nonzero(truth, axis=1)
    norm, union = np.sqrt(one * other.astype(np.float64)), one + other - both
    return np.column_stack([both / np.maximum(norm, 1.0), both / np.maximum(union, 1.0)])


def ssim(a: Image, b: Image) -> float:
    """Mean structural similarity of two (h, w) images with values in [0, 1], as scikit-image's with `SSIM_SETTINGS`.

    It is computed around the ink only: where both windows are blank it is 1.
    """
    _check(a, b)
    margin, places = SSIM_RADIUS, (a.shape[0] - 2 * SSIM_RADIUS) * (a.shape[1] - 2 * SSIM_RADIUS)
    window = inked_window(a, b, 2 * margin)
    x, y = a[window].astype(np.float64), b[window].astype(np.float64)
    ux, uy, uxx, uyy, uxy = (
        cv2.GaussianBlur(image, (2 * margin + 1, 2 * margin + 1), SSIM_SIGMA)[margin:-margin, margin:-margin]
        for image in (x, y, x * x, y * y, x * y)
    )
    means, squares = ux * uy, ux * ux + uy * uy
    values = (2.0 * means + C1) * (2.0 * (uxy - means) + C2) / ((squares + C1) * (uxx + uyy - squares + C2))
    return float(1.0 - (values.size - values.sum()) / places)


def inked_window(a: Image, b: Image, margin: int) -> tuple[slice, slice]:
    """The rows and columns where either image has ink, and `margin` px more on each side; all of blank images."""
    ink = (a != 0) | (b != 0)
    if not ink.any():
        return slice(None), slice(None)
    inked = (np.flatnonzero(ink.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(0, int(at[0]) - margin), int(at[-1]) + 1 + margin) for at in inked)
    return rows, columns


def _check(a: Image, b: Image) -> None:
    if a.shape != b.shape or a.ndim != 2:
        raise ValueError(f"images must be (h, w) and of one shape, got {a.shape} and {b.shape}")
