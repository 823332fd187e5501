"""How alike two images of ink are: CSIM, SSIM and IoU.

Ink is 1 and paper 0: with paper as 1, a blank page would score .94.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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


def ssim(a: Image, b: Image) -> float:
    """Mean structural similarity of two (h, w) images with values in [0, 1], as scikit-image's with `SSIM_SETTINGS`."""
    _check(a, b)
    return float(csim_and_ssim(a, b[None])[0, 1])


def csim_and_ssim(image: Image, others: Image) -> Floats:
    """(n, 2) CSIM and SSIM of an image (h, w) and each of n >= 1 others (n, h, w); CSIM is NaN where one is blank.

    SSIM is computed around the ink only: where both windows are blank it is 1.
    """
    margin, (height, width) = SSIM_RADIUS, image.shape
    window = inked_window(image, others, 2 * margin)
    x, y = (np.asarray(part, np.float64) for part in (image[window], others[:, *window]))
    xx, yy, xy = x * x, y * y, x * y
    norm = np.sqrt(xx.sum() * yy.sum(axis=(1, 2)))
    cosine = np.divide(xy.sum(axis=(1, 2)), norm, out=np.full(len(others), np.nan), where=norm > 0.0)

    def blurred(stack: Floats) -> Floats:
        # Rows of all images below each other: what one image's blur takes from the next is in the margin.
        tall = cv2.GaussianBlur(stack.reshape(-1, stack.shape[-1]), (2 * margin + 1, 2 * margin + 1), SSIM_SIGMA)
        return np.asarray(tall, np.float64).reshape(stack.shape)[..., margin:-margin, margin:-margin]

    ux, uy, uxx, uyy, uxy = map(blurred, (x, y, xx, yy, xy))
    means, squares = ux * uy, ux * ux + uy * uy
    values = (2.0 * means + C1) * (2.0 * (uxy - means) + C2) / ((squares + C1) * (uxx + uyy - squares + C2))
    places = (height - 2 * margin) * (width - 2 * margin)
    return np.column_stack([cosine, 1.0 - (1.0 - values).sum(axis=(1, 2)) / places])


def binary_scores(seen: NDArray[np.bool_], truth: NDArray[np.bool_]) -> Floats:
    """(n, 2) CSIM and IoU of n pairs of (h, w) images of ink or paper; 0 where either is blank."""
    seen, truth = seen.reshape(len(seen), -1), truth.reshape(len(truth), -1)
    both = np.count_nonzero(seen & truth, axis=1).astype(np.float64)
    one, other = np.count_nonzero(seen, axis=1), np.count_nonzero(truth, axis=1)
    norm, union = np.sqrt(one * other.astype(np.float64)), one + other - both
    return np.column_stack([both / np.maximum(norm, 1.0), both / np.maximum(union, 1.0)])


def inked_window(image: Image, others: Image, margin: int) -> tuple[slice, slice]:
    """The rows and columns where (h, w) or any of (..., h, w) has ink, and `margin` px more on each side.

    All rows and columns of blank images.
    """
    ink = np.logical_or(image != 0, others != 0).reshape(-1, *image.shape).any(axis=0)
    if not ink.any():
        return slice(None), slice(None)
    inked = (np.flatnonzero(ink.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(0, int(at[0]) - margin), int(at[-1]) + 1 + margin) for at in inked)
    return rows, columns


def _check(a: Image, b: Image) -> None:
    if a.shape != b.shape or a.ndim != 2:
        raise ValueError(f"images must be (h, w) and of one shape, got {a.shape} and {b.shape}")


class Similarity(NamedTuple):
    """How alike two images are, from 0 to 1."""

    csim: float
    ssim: float


def compare(image: Image, other: Image) -> Similarity:
    """Compare two images of one shape with ink as 1 and paper as 0. Raises ValueError for a blank image."""
    return Similarity(csim(image, other), ssim(image, other))
