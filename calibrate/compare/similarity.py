"""CSIM and SSIM of two images, and how the images are aligned first.

Ink is 1 and paper 0: with paper as 1, a blank page would score .94.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.field import Alignment, best_shift

Image = NDArray[Any]

SSIM_SIGMA = 1.5
SSIM_SETTINGS = (
    f"scikit-image structural_similarity, data_range 1, gaussian weights, sigma {SSIM_SIGMA}, population covariance"
)


class Polarity(StrEnum):
    """Whether ink or paper is 1."""

    INK = "ink = 1"
    PAPER = "paper = 1"


def similarity(
    captured: Image, other: Image, alignment: Alignment, polarity: Polarity = Polarity.INK
) -> tuple[float, float]:
    """(CSIM, SSIM) of two (128, 128) images of one alignment; if size-normalised, the other is shifted to best overlap.

    Raises ValueError for a blank image. `compiled.py` does the same for one capture and many predictions.
    """
    if alignment is Alignment.SIZE_NORMALISED:
        other = best_shift(other, captured)
    if not captured.any() or not other.any():
        raise ValueError("a blank image")
    if polarity is Polarity.PAPER:
        captured, other = 1.0 - captured, 1.0 - other
    return csim(captured, other), ssim(captured, other)


def csim(a: Image, b: Image) -> float:
    """Cosine similarity of two (h, w) images with values in [0, 1]. Raises ValueError if one is blank.

    `calibrate/compare/compiled.py` computes the same for all images of a validation at once.
    """
    _check(a, b)
    x, y = a.astype(np.float64).ravel(), b.astype(np.float64).ravel()
    norm = float(np.linalg.norm(x) * np.linalg.norm(y))
    if norm == 0.0:
        raise ValueError("cosine similarity is not defined for a blank image")
    return float(x @ y) / norm


def binary_scores(seen: NDArray[np.bool_], truth: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(n, 2) CSIM and IoU of n pairs of (h, w) images of ink or paper; 0 where either is blank."""
    seen, truth = seen.reshape(len(seen), -1), truth.reshape(len(truth), -1)
    both = np.count_nonzero(seen & truth, axis=1).astype(np.float64)
    one, other = np.count_nonzero(seen, axis=1), np.count_nonzero(truth, axis=1)
    norm, union = np.sqrt(one * other.astype(np.float64)), one + other - both
    return np.column_stack([both / np.maximum(norm, 1.0), both / np.maximum(union, 1.0)])


def ssim(a: Image, b: Image) -> float:
    """Mean structural similarity of two (h, w) images with values in [0, 1], with `SSIM_SETTINGS`."""
    import skimage.metrics

    _check(a, b)
    untyped: Any = skimage.metrics
    value = untyped.structural_similarity(
        a.astype(np.float64),
        b.astype(np.float64),
        data_range=1.0,
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
    )
    return float(value)


def _check(a: Image, b: Image) -> None:
    if a.shape != b.shape or a.ndim != 2:
        raise ValueError(f"images must be (h, w) and of one shape, got {a.shape} and {b.shape}")
