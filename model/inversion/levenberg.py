"""Levenberg-Marquardt for a batch, with bounded steps inside a box (K. Levenberg 1944, D. Marquardt 1963).

Minimises cost / s^2 + sum ((value - mean) / sigma)^2, where s^2 is the mean square residual of the current iterate,
so that a prior has the right weight at any noise level. Without priors this is plain least squares.

Where a boundary is pixels away from the target's, the cost grows only linearly and J'J overestimates its curvature:
steps become too short. So each step is stretched by the curvature measured along the previous one, a secant estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.model.inversion.forward import Forward, Images, Normal

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
_FRACTION = 0.03
_MOST_STRETCH, _SHORT = 16.0, 0.7
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e9


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of P parameters, each (P,): box, longest step, step that counts as converged, and prior precisions."""

    low: Floats
    high: Floats
    step: Floats
    still: Floats
    precision: Floats
    """1 / sigma^2; 0 for no prior."""
    iterations: int = 40


@dataclass(frozen=True, slots=True)
class Fit:
    """Results of B fits: values (B, P), the sums there, whether they converged, and the number of iterations."""

    values: Floats
    normal: Normal
    converged: Flags
    iterations: NDArray[np.int64]
    pixels: int


def fit(forward: Forward, target: Images, start: Floats, limits: Limits, prior: Floats | None = None) -> Fit:
    """Fit B images from `start` (B, P); `prior` (B, P) are the means of the priors, by default the start."""
    count, free = start.shape
    pixels = target.shape[1] * target.shape[2]
    mean = start if prior is None else prior
    values = np.clip(start, limits.low, limits.high)
    own = np.arange(count)
    now = forward.normal(values, target, own)
    damping = np.full(count, 1e-3)
    stretch = np.ones(count)
    converged = np.zeros(count, np.bool_)
    taken = np.zeros(count, np.int64)
    active = own
    for _ in range(limits.iterations):
        noise = now.cost[active] / max(pixels - free, 1)
        precision = noise[:, None] * limits.precision
        off = mean[active] - values[active]
        hessian = now.hessian[active] + precision[:, :, None] * np.eye(free)
        gradient = now.gradient[active] + precision * off
        step = _step(hessian, gradient, damping[active], stretch[active], values[active], limits)
        tried = np.clip(values[active] + step, limits.low, limits.high)
        step = tried - values[active]
        # With noise, a step below a thirtieth of the standard deviation is convergence; a clean image never gets there.
        quadratic = np.einsum("bi,bij,bj->b", step, hessian, step)
        still = np.all(np.abs(step) < limits.still, axis=1) | (quadratic < _FRACTION**2 * noise)
        there = forward.of(active).normal(tried, target, active)
        was = now.cost[active] + np.sum(precision * off**2, axis=1)
        cost = there.cost + np.sum(precision * (mean[active] - tried) ** 2, axis=1)
        better = cost <= was
        taken[active] += 1
        kept = active[better]
        values[kept] = tried[better]
        for mine, new in zip(_parts(now), _parts(there), strict=True):
            mine[kept] = new[better]
        left = np.sum((there.gradient + precision * (mean[active] - tried)) * step, axis=1)
        curved = 1.0 - left / np.maximum(np.sum(gradient * step, axis=1), 1e-300)
        longer = np.clip(stretch[active] / np.maximum(curved, 1e-3), 1.0, _MOST_STRETCH)
        # A stretched step that failed was stretched too far; it does not need more damping: damping it as well would
        # shorten the next step, whose secant would then call for the same stretch again.
        change = np.where(better, 0.1, np.where(stretch[active] > 1, 1.0, 10.0))
        damping[active] = np.clip(damping[active] * change, _LEAST_DAMPING, _MOST_DAMPING)
        stretch[active] = np.where(better & (curved < _SHORT), longer, 1.0)
        converged[active[still]] = True
        active = active[~still & (damping[active] < _MOST_DAMPING)]
        if len(active) == 0:
            break
    return Fit(values, now, converged, taken, pixels)


def _step(
    hessian: Floats, gradient: Floats, damping: Floats, stretch: Floats, values: Floats, limits: Limits
) -> Floats:
    """The damped Gauss-Newton step, no longer than allowed; parameters pushed against the box do not move."""
    held = ((values <= limits.low) & (gradient < 0)) | ((values >= limits.high) & (gradient > 0))
    step = _solved(hessian, gradient, damping, held)
    # Check again: the step may leave the box at a parameter that the gradient alone would not have held.
    out = held | ((values <= limits.low) & (step < 0)) | ((values >= limits.high) & (step > 0))
    if (out & ~held).any():
        step = _solved(hessian, gradient, damping, out)
    step = step * stretch[:, None]
    longest = np.max(np.abs(step) / limits.step, axis=1, keepdims=True)
    return step / np.maximum(longest, 1.0)


def _solved(hessian: Floats, gradient: Floats, damping: Floats, held: Flags) -> Floats:
    free = ~held
    matrix = hessian * (free[:, :, None] & free[:, None, :])
    diagonal = np.einsum("bii->bi", matrix)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    # Scaled to a unit diagonal: mixing millimetres and degrees would lose precision.
    unit = matrix / (scale[:, :, None] * scale[:, None, :])
    at = np.arange(matrix.shape[1])
    unit[:, at, at] = 1.0 + damping[:, None]
    right = np.where(held, 0.0, gradient) / scale
    return np.linalg.solve(unit, right[..., None])[..., 0] / scale


def _parts(normal: Normal) -> tuple[Floats, ...]:
    return normal.hessian, normal.gradient, normal.cost, normal.meat, normal.cut
