"""Fit `model.fitted` to coverage images: its parameters by least squares with a prior, then what they cannot express.

No press repeats exactly: width, place and lengths differ from press to press, each by one amount along the whole mark.
The fit allows for these differences (`STRAYS`): each stroke may have its own, at the cost that their spread says.

What the parameters cannot express are residuals, by empirical Bayes. Each stroke is compared with the fitted
parameters: how much further its tip and its heel reach, and by which polynomials along the mark its half width differs
from the profile and its middle from the axis. Over the strokes, each number is a polynomial in depth and tilt plus the
stroke's own deviation. The scales of its constant, of its other terms and of the deviations are those with the greatest
marginal likelihood on a grid (D. MacKay, "Bayesian interpolation", 1992), with a weak prior on each scale. So the fit
smooths strokes that repeat badly and follows strokes that repeat well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import itemgetter

import numpy as np

from brushloop.model.damped import Damping, Equations, descend
from brushloop.model.fitted import (
    MODES,
    NAMES,
    PARAMETERS,
    TERMS,
    FittedPress,
    Floats,
    Prior,
    Sizes,
    chance_within,
    command_terms,
    learned,
    modes,
    spreads,
)
from brushloop.model.presses import DepthTilt, Grid, Presses

SPREAD_MM = 0.25
"""Variation of an edge from press to press (scale of a logistic)."""
ALL = tuple(range(len(NAMES)))
SCALE = tuple(NAMES.index(name) for name in ("lam", "heel_gain", "tip_gain", "origin_mm"))
"""Size and place of the marks."""
ROUNDS = 40
DAMPING = Damping(1e-2, 6.0, 8.0, 1e-7, 1e5, floor=0.0)
STEP = 1e-4
"""Step of a derivative, as a share of the parameter's spread."""
STRAYS = {"lam": 0.09, "origin_mm": 0.3, "heel_gain": 0.3, "tip_gain": 0.04}
"""Standard deviations by which single presses of a brush differ: about 5 % of width and lengths, 0.3 mm of place."""
TERM_SCALE = (1.0, 1.0, 0.8, 0.8, 0.8, 0.8)
"""Expected sizes of the terms: the first in units of the constant's scale, the rest in units of the others' scale."""
CONSTANT = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
OTHERS = (0.03, 0.07, 0.15, 0.3, 0.6, 1.2)
OWN = (0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)
EXPECTED = (0.3, 0.3, 0.03)
"""Scales of constant, other terms and a stroke's own deviation that are most plausible beforehand, mm for the first
of `modes`; each may well be e times larger or smaller."""
END_MM = 1.5
"""Plausible error of a length; the scales of the ends are in units of it."""
END_PX = 1.8
"""Pixels of wrong ink that cost as much as an end that is 1 mm off."""
END_STEP_MM, END_ROUNDS = 0.05, 4
LEAST_MM = 0.3
"""Width from which a column of ink has a middle."""


def fit_presses(
    presses: Presses, *, residual: bool = True, prior: Prior | None = None, start: Floats | None = None
) -> FittedPress:
    """Fit the parameters, then the residual that they cannot express. By default the prior is `learned`.

    The cost has several minima. Of two descents, one from the prior and one that fits size and place of the marks
    first, the lower one counts; with `start` (17,), the parameters of a fit to nearly the same presses, one descent
    from there. Parameters that the presses do not determine have the values that the prior expects. Raises ValueError
    without a press.
    """
    if not len(presses):
        raise ValueError("a fit needs at least one press")
    presses = presses.near_ink()
    prior = learned() if prior is None else prior
    expected = FittedPress(presses.radius_mm, presses.length_mm, prior.values if start is None else start)
    starts = [expected]
    if start is None:
        starts.append(_minimise(expected, SCALE, presses, prior)[0])
    press, _ = min((_minimise(begin, ALL, presses, prior) for begin in starts), key=itemgetter(1))
    return fit_residual(press, presses) if residual else press


@dataclass(frozen=True, slots=True)
class Drawn:
    """A mark as a brush without residuals predicts it, with its derivatives by P numbers.

    Such a number moves both edges of the mark, and the ink of a pixel depends only on the edge on its side. So the
    Jacobian J of the image is d ink / d half width, one image, times the derivatives of the half width, and J'J and J'r
    are sums over columns. Matrices of that size are also too small for a matrix library to start threads for them.
    """

    ink: Floats
    """Probability of ink (len(y_mm), len(x_mm))."""
    by_width: Floats
    """Its derivative by the half width, 1/mm."""
    widths: Floats
    """Derivatives of the half width (P, len(x_mm)), mm."""

    @classmethod
    def of(cls, width: Floats, widths: Floats, y_mm: Floats) -> Drawn:
        """The mark of half width (N,) with these derivatives."""
        ink = chance_within(width, y_mm[:, None], SPREAD_MM)
        return cls(ink, ink * (1.0 - ink) / SPREAD_MM, widths)

    def square(self) -> Floats:
        """J'J, (P, P)."""
        return (self.widths * np.einsum("yx,yx->x", self.by_width, self.by_width)) @ self.widths.T

    def pull(self, residuals: Floats) -> Floats:
        """J'r, (n, P), of n images of residuals."""
        return np.einsum("yx,nyx->nx", self.by_width, residuals) @ self.widths.T


def draw(press: FittedPress, conditions: Floats, grid: Grid, free: Sequence[int] = ALL) -> list[Drawn]:
    """Draw presses at C depths and tilts (C, 2), with derivatives by the free parameters over their spreads."""
    moved = press.values + np.concatenate([np.zeros((1, len(NAMES))), STEP * np.diag(spreads())[list(free)]])
    batch = replace(press, values=moved[:, None])
    width, *others = batch.half_width(batch.sizes(*conditions.T), grid.x_mm)
    by_parameter = (np.stack(others, axis=1) - width[:, None]) / STEP
    return [Drawn.of(*of_condition, grid.y_mm) for of_condition in zip(width, by_parameter, strict=True)]


def _minimise(press: FittedPress, free: Sequence[int], presses: Presses, prior: Prior) -> tuple[FittedPress, float]:
    """Levenberg-Marquardt from `press`, and the cost where it ends; a parameter one standard deviation off the prior
    costs as much as a pixel of wrong ink."""
    inks = {condition: presses.ink[numbers] for condition, numbers in presses.conditions.items()}
    at = list(free)
    low, high = (np.array([getattr(PARAMETERS[k], end) for k in at]) for end in ("low", "high"))

    def at_values(vector: Floats) -> FittedPress:
        values = press.values.copy()
        values[at] = vector
        return replace(press, values=values)

    def equations(vector: Floats) -> Equations:
        trial = at_values(vector)
        square, gradient, cost = _normal(trial, at, inks, presses.grid)
        pull = prior.precision @ prior.off(trial.values)
        cost += 0.5 * float(prior.off(trial.values) @ pull)
        square += prior.precision[np.ix_(at, at)]
        gradient += pull[at]
        # A parameter that is pulled beyond its bound stays there: the step of the others must not count on it.
        held = ((vector <= low) & (gradient > 0.0)) | ((vector >= high) & (gradient < 0.0))
        square[held], square[:, held], gradient[held] = 0.0, 0.0, 0.0
        square[held, held] = 1.0
        return Equations(cost, square, gradient)

    def feasible(vector: Floats) -> Floats | None:
        """Within the bounds; None if a press would not reach the paper."""
        clipped = np.clip(vector, low, high)
        h0_mm = at_values(clipped).values[NAMES.index("h0_mm")]
        return None if presses.commands[:, 0].min() + h0_mm <= 0.1 else clipped

    lowest = descend(
        equations,
        press.values[at],
        rounds=ROUNDS,
        most=1.0,
        gain=1e-4,
        scale=spreads()[at],
        damping=DAMPING,
        feasible=feasible,
    )
    return at_values(lowest.vector), lowest.at.cost


def _normal(
    press: FittedPress, at: Sequence[int], inks: Mapping[DepthTilt, Floats], grid: Grid
) -> tuple[Floats, Floats, float]:
    """J'J (P, P) and J'r (P,) by the P parameters `at`, and half the sum of squares, over all strokes.

    `inks` (n, len(y_mm), len(x_mm)) are the strokes of each condition. Strays are integrated out.
    """
    strays = [NAMES.index(name) for name in STRAYS]
    sizes = np.array(list(STRAYS.values())) / spreads()[strays]
    free = sorted({*at, *strays})
    stray, kept = ([free.index(k) for k in chosen] for chosen in (strays, at))
    squares, gradient, cost = np.zeros((len(free), len(free))), np.zeros(len(free)), 0.0
    for drawn, ink in zip(draw(press, np.array(list(inks)), grid, free), inks.values(), strict=True):
        square, miss = drawn.square(), drawn.ink - ink
        pull, by_stray = drawn.pull(miss), square[stray]
        taken = np.linalg.solve(by_stray[:, stray] + np.diag(sizes**-2.0), np.column_stack([by_stray, pull.T[stray]]))
        squares += len(ink) * (square - by_stray.T @ taken[:, : len(free)])
        shift = taken[:, len(free) :]
        gradient += (pull.T - by_stray.T @ shift).sum(axis=1)
        # Not a dot product, which would start the matrix library's threads.
        cost += 0.5 * float(np.einsum("nyx,nyx->", miss, miss) - np.sum(pull.T[stray] * shift))
    return squares[np.ix_(kept, kept)], gradient[kept], cost


def fit_residual(press: FittedPress, presses: Presses) -> FittedPress:
    """The brush with its residuals; `press` has none."""
    (depths, tilts), inks, grid = presses.commands.T, presses.ink, presses.grid
    terms = command_terms(depths, tilts)
    ends = _ends(press, depths, tilts, inks, grid)
    falling = 1.0 / np.arange(MODES).clip(1)
    seen = _across(press, press.sizes(depths, tilts, ends), inks, grid)
    lengths = [regress(ends[:, [k]], terms, np.array([END_MM]))[0] for k in range(2)]
    return replace(press, across=np.array([regress(each, terms, falling) for each in seen]), ends=np.array(lengths))


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


def _ends(press: FittedPress, depths_mm: Floats, tilts_deg: Floats, inks: Floats, grid: Grid) -> Floats:
    """By how much the tip and heel of strokes reach beyond the brush's lengths, (strokes, 2) mm, by Gauss-Newton."""

    def width(further: Floats) -> Floats:
        return press.half_width(press.sizes(depths_mm, tilts_deg, further), grid.x_mm)

    ends = np.zeros((len(inks), 2))
    for _ in range(END_ROUNDS):
        here = width(ends)
        by_end = np.stack([(width(ends + END_STEP_MM * way) - here) / END_STEP_MM for way in np.eye(2)], axis=1)
        for k, ink in enumerate(inks):
            drawn = Drawn.of(here[k], by_end[k], grid.y_mm)
            pull = drawn.pull((ink - drawn.ink)[None])[0] - END_PX * ends[k]
            step = np.asarray(np.linalg.solve(drawn.square() + END_PX * np.eye(2), pull), np.float64)
            ends[k] += step.clip(-0.7, 0.7)
    return ends


def _across(press: FittedPress, sizes: Sizes, inks: Floats, grid: Grid) -> Floats:
    """By which `modes` half widths differ from the profile, and middles from the axis, (2, strokes, MODES)."""
    share = sizes.share(grid.x_mm)
    across = inks.sum(axis=1) * grid.px_mm
    inked = (share > 0.0) & (share < 1.0) & (across > LEAST_MM)
    half = 0.5 * across - press.half_width(sizes, grid.x_mm)
    middle = np.einsum("nyx,y->nx", inks, grid.y_mm) * grid.px_mm / np.maximum(across, LEAST_MM)
    waves = modes(share) * inked[..., None]
    along = waves.swapaxes(1, 2)
    little = 0.005 * inked.sum(axis=1)[:, None, None] * np.eye(MODES)
    seen = along @ np.stack([half, middle], axis=-1)
    return np.moveaxis(np.asarray(np.linalg.solve(along @ waves + little, seen), np.float64), -1, 0)
