"""What a brush does that its parameters cannot express: residuals of its edges and ends, by empirical Bayes.

Each stroke is compared with the fitted parameters: how much further its tip and its heel reach, and by which sines each
of its edges differs from the profile. Over the strokes, each of these numbers is a polynomial in depth and tilt plus
the stroke's own deviation. The scales of the polynomial's constant, of its other terms and of the deviations are those
with the greatest marginal likelihood on a grid (D. MacKay, "Bayesian interpolation", 1992), with a weak prior on each
scale. So the fit smooths strokes that repeat badly and follows strokes that repeat well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.fit.captures import SPREAD_MM, Grid, Pressed
from brushloop.model.fitted import MODES, TERMS, FittedPress, command_terms, modes

Floats = NDArray[np.float64]

TERM_SCALE = (1.0, 1.0, 0.8, 0.8, 0.8, 0.8)
"""Expected sizes of the terms: the first in units of the constant's scale, the rest in units of the others' scale."""
CONSTANT = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
OTHERS = (0.03, 0.07, 0.15, 0.3, 0.6, 1.2)
OWN = (0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)
EXPECTED = (0.3, 0.3, 0.1)
"""Scales of constant, other terms and a stroke's own deviation that are most plausible beforehand, mm for the first
sine; each may well be e times larger or smaller."""
END_MM = 1.5
"""Plausible error of a length; the scales of the ends are in units of it."""
END_NOISE = 4.0
"""Variance of a pixel times the number of pixels whose errors are correlated, where an end is sought."""
END_STEP_MM, END_ROUNDS = 0.05, 4


def fit_residual(press: FittedPress, strokes: Sequence[Pressed], grid: Grid) -> FittedPress:
    """The brush with the residuals of its ends and edges; `press` has none."""
    terms = np.array([command_terms(s.depth_mm, s.tilt_deg) for s in strokes])
    ends = np.array([_ends(press, s, grid) for s in strokes])
    sides = np.array([_sines(press, s, end, grid) for s, end in zip(strokes, ends, strict=True)])
    falling = 1.0 / np.arange(1, MODES + 1)
    # Half the sum of the edges is a mark's width, half the difference a bow: each has scales of its own.
    width, bow = (regress(0.5 * (sides[:, 0] + way * sides[:, 1]), terms, falling) for way in (1.0, -1.0))
    lengths = [END_MM * regress(ends[:, [k]] / END_MM, terms, np.ones(1))[0] for k in range(2)]
    return replace(press, edges=np.array([width + bow, width - bow]), ends=np.array(lengths))


def regress(seen: Floats, terms: Floats, scale: Floats) -> Floats:
    """Coefficients (K, TERMS) of the polynomials for K numbers `seen` (strokes, K), of expected sizes `scale` (K,)."""
    count = len(seen)
    square, right = terms.T @ terms, terms.T @ (seen / scale)
    total = float(np.sum((seen / scale) ** 2))
    choices = np.array(list(product(CONSTANT, OTHERS, OWN)))
    size = np.concatenate([choices[:, :1], np.repeat(choices[:, 1:2], TERMS - 1, axis=1)], axis=1) * TERM_SCALE
    noise = choices[:, 2] ** 2
    # Scaled by the terms' sizes, the prior is the unit matrix times the noise.
    scaled = square * size[:, :, None] * size[:, None, :] + noise[:, None, None] * np.eye(TERMS)
    found = np.linalg.solve(scaled, size[:, :, None] * right)
    explained = np.einsum("ctk,tk,ct->c", found, right, size)
    determinant = np.linalg.slogdet(scaled)[1] + (count - TERMS) * np.log(noise)
    likelihood = -0.5 * (seen.shape[1] * determinant + (total - explained) / noise)
    likelihood -= 0.5 * np.sum(np.log(choices / EXPECTED) ** 2, axis=1)
    best = int(np.argmax(likelihood))
    return (size[best, :, None] * found[best]).T * scale[:, None]


def _ends(press: FittedPress, stroke: Pressed, grid: Grid) -> Floats:
    """By how much the stroke's tip and heel reach beyond the lengths of the brush, (2,) mm, by Gauss-Newton."""

    def image(further: Floats) -> Floats:
        return _stretched(press, further).chance(stroke.depth_mm, stroke.tilt_deg, grid.x_mm, grid.y_mm, SPREAD_MM)

    sizes = press.sizes(stroke.depth_mm, stroke.tilt_deg)
    reach = np.array([float(sizes.tip), float(sizes.heel)])
    weight = END_NOISE / END_MM**2
    found = np.zeros(2)
    for _ in range(END_ROUNDS):
        here = image(found)
        by_end = np.array([(image(found + END_STEP_MM * way) - here).ravel() / END_STEP_MM for way in np.eye(2)])
        pull = by_end @ (stroke.ink - here).ravel() - weight * found
        step = np.linalg.solve(by_end @ by_end.T + weight * np.eye(2), pull)
        found = np.clip(found + np.clip(step, -0.7, 0.7), -0.5 * reach, reach)
    return found


def _sines(press: FittedPress, stroke: Pressed, ends: Floats, grid: Grid) -> Floats:
    """The sines (2, MODES) by which the stroke's upper and lower edge differ from the profile between its ends, mm."""
    own = _stretched(press, ends)
    sizes = own.sizes(stroke.depth_mm, stroke.tilt_deg)
    share = (grid.x_mm - sizes.widest + sizes.tip) / (sizes.tip + sizes.heel)
    on = (share > 0.0) & (share < 1.0)
    waves = modes(share[on])
    width = np.maximum(own.half_width(stroke.depth_mm, stroke.tilt_deg, grid.x_mm[on]), 0.0)
    above = grid.y_mm > 0.0
    edges = np.array([stroke.ink[rows][:, on].sum(axis=0) * grid.px_mm - width for rows in (above, ~above)])
    little = 0.005 * len(waves) * np.eye(MODES)
    return np.asarray(np.linalg.solve(waves.T @ waves + little, waves.T @ edges.T).T, np.float64)


def _stretched(press: FittedPress, further: Floats) -> FittedPress:
    """The brush with ends further out by constants."""
    ends = np.zeros((2, TERMS))
    ends[:, 0] = further
    return replace(press, ends=ends)
