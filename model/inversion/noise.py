"""Uncertainty of a recovered press, by three models of the difference between an image and the model's image.

`pixel`      each pixel has independent noise of one variance, estimated from the residuals: s^2 (J'J)^-1 with
             s^2 = r'r / (N - P). For gray images with sensor noise.
`quantised`  each pixel says only whether it is more than half covered. The effect of rounding is computed: presses
             near the estimate are drawn, rounded, and fitted again by two Gauss-Newton steps; the spread of these
             errors is the covariance. Rounding errors are neither independent nor equal, as (J'J)^-1 would require.
`blocks`     residuals may be arbitrarily correlated within squares of 16 pixels, and are independent between them:
             the sandwich (J'J)^-1 M (J'J)^-1 with M the sum over squares of (J'r)(J'r)' (K.-Y. Liang and S. Zeger,
             1986). For captures, where the model is wrong by more than noise.

None of them includes errors of the brush's R, of lambda, or of the scale: these shift every press of a session alike.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from brushloop.model.inversion.forward import BLOCK_PX, Forward
from brushloop.model.inversion.levenberg import Fit, Limits

Floats = NDArray[np.float64]
LEAST_NOISE = 1e-6
"""Error of the rasteriser in a pixel: a clean image is no more accurate than this."""
REDRAWS = 12
"""Presses drawn near each estimate for `quantised`."""
STEPS = 2
_FEW = 2.179 / 1.960
"""Ratio of Student's 97.5 % quantile for REDRAWS degrees of freedom to the normal one."""


class Noise(StrEnum):
    """Model of the differences between an image and the fitted one."""

    PIXEL = "pixel"
    QUANTISED = "quantised"
    BLOCKS = "blocks"


def covariance(noise: Noise, forward: Forward, found: Fit, limits: Limits, near: Floats, seed: int = 0) -> Floats:
    """The covariance of the values of a fit, (B, P, P); NaN where the images do not determine them.

    `near` (P,) is the distance within which a press is as likely as the estimate; only `quantised` uses it.
    """
    free = found.values.shape[1]
    variance = np.maximum(found.normal.cost / max(found.pixels - free, 1), LEAST_NOISE**2)
    prior = variance[:, None] * limits.precision
    bread = _inverse(found.normal.hessian + prior[:, :, None] * np.eye(free))
    from_prior = (variance[:, None] * prior)[:, :, None] * np.eye(free)
    match noise:
        case Noise.PIXEL:
            return variance[:, None, None] * bread
        case Noise.BLOCKS:
            side = -(-int(found.pixels**0.5) // BLOCK_PX)
            # Only blocks on the boundary carry information: about as many as lie along two sides of the image.
            few = 2 * side / max(2 * side - 1, 1)
            return bread @ (few * found.normal.meat + from_prior) @ bread
        case Noise.QUANTISED:
            # The errors of the prior and of rounding are independent.
            # The spread of so few draws is itself uncertain, which is why a ratio of quantiles is used.
            return _FEW**2 * _rounding(forward, found, limits, near, prior, seed) + bread @ from_prior @ bread


def _rounding(forward: Forward, found: Fit, limits: Limits, near: Floats, prior: Floats, seed: int) -> Floats:
    """The covariance of fits by two Gauss-Newton steps, from presses near the estimates to their own rounded images."""
    count, free = found.values.shape
    jitter = np.random.default_rng(seed).uniform(-1, 1, (count * REDRAWS, free)) * near
    own = np.repeat(np.arange(count), REDRAWS)
    values = np.clip(found.values[own] + jitter, limits.low, limits.high)
    outer = np.zeros((count, free, free))
    for part in np.array_split(np.arange(len(own)), max(1, len(own) // 256)):
        at, mine = values[part], own[part]
        here, row = forward.of(mine), np.arange(len(part))
        rounded = (here.predict(at) > 0.5).astype(np.float32)
        error = np.zeros_like(at)
        for _ in range(STEPS):
            sums = here.normal(np.clip(at + error, limits.low, limits.high), rounded, row)
            inverse = _inverse(sums.hessian + prior[mine][:, :, None] * np.eye(free))
            error += (inverse @ (sums.gradient - prior[mine] * error)[..., None])[..., 0]
        np.add.at(outer, own[part], error[:, :, None] * error[:, None, :])
    return outer / REDRAWS


def _inverse(matrix: Floats) -> Floats:
    """Inverses scaled to a unit diagonal first; NaN for matrices that are singular to rounding."""
    diagonal = np.einsum("bii->bi", matrix)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scales = scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(np.where(np.isfinite(matrix), matrix / scales, 0.0))
    least = values[:, :1] > 1e-12
    inverse = (vectors / np.where(least, values, 1.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.where(least[..., None], inverse / scales, np.nan)
