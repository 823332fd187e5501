"""CSIM and SSIM of two aligned images. Ink is 1 on 0: with paper as 1, a blank page would score .94."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]

SSIM_SIGMA = 1.5
SSIM_SETTINGS = (
    f"scikit-image structural_similarity, data_range 1, gaussian weights, sigma {SSIM_SIGMA}, population covariance"
)


def csim(a: Image, b: Image) -> float:
    """Cosine similarity of two (h, w) images with values in [0, 1]. Raises ValueError for a blank one."""
    _check(a, b)
    x, y = a.astype(np.float64).ravel(), b.astype(np.float64).ravel()
    norm = float(np.linalg.norm(x) * np.linalg.norm(y))
    if norm == 0.0:
        raise ValueError("cosine similarity is not defined for a blank image")
    return float(x @ y) / norm


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
        raise ValueError(f"images must be (h, w) and alike, got {a.shape} and {b.shape}")
