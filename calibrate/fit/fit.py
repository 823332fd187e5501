"""Fit `model.fitted` to coverage images: its parameters by least squares with a prior, then what they cannot express.

No press repeats exactly: width, place and lengths differ from press to press, each by one amount along the whole mark.
These differences (`STRAYS`) are integrated out of the likelihood, linearised at the fit.

What the parameters cannot express are residuals of the edges and ends, by empirical Bayes. Each stroke is compared with
the fitted parameters: how much further its tip and its heel reach, and by which sines each of its edges differs from
the profile. Over the strokes, each of these numbers is a polynomial in depth and tilt plus the stroke's own deviation.
The scales of the polynomial's constant, of its other terms and of the deviations are those with the greatest marginal
likelihood on a grid (D. MacKay, "Bayesian interpolation", 1992), with a weak prior on each scale. So the fit smooths
strokes that repeat badly and follows strokes that repeat well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.fit.captures import SPREAD_MM, Grid, Pressed
from brushloop.calibrate.fit.prior import Prior, learned, spreads
from brushloop.model.damped import Damping, Equations, descend
from brushloop.model.fitted import MODES, NAMES, PARAMETERS, TERMS, FittedPress, chance_within, command_terms, modes

Floats = NDArray[np.float64]

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
EXPECTED = (0.3, 0.3, 0.1)
"""Scales of constant, other terms and a stroke's own deviation that are most plausible beforehand, mm for the first
sine; each may well be e times larger or smaller."""
END_MM = 1.5
"""Plausible error of a length; the scales of the ends are in units of it."""
END_NOISE = 4.0
"""Variance of a pixel times the number of pixels whose errors are correlated, where an end is sought."""
END_STEP_MM, END_ROUNDS = 0.05, 4


def fit_presses(
    strokes: Sequence[Pressed],
    grid: Grid,
    radius_mm: float,
    length_mm: float,
    *,
    residual: bool = True,
    prior: Prior | None = None,
    start: Floats | None = None,
) -> FittedPress:
    """Fit the parameters, then the residual that they cannot express. By default the prior is `learned`.

    The cost has several minima. Of two descents, one from the prior and one that fits size and place of the marks
    first, the lower one counts; with `start` (17,), the parameters of a fit to nearly the same strokes, one descent
    from there. Parameters that the strokes do not determine have the values that the prior expects. Raises ValueError
    without a stroke.
    """
    prior = learned() if prior is None else prior
    expected = FittedPress(radius_mm, length_mm, prior.values if start is None else start)
    starts = [expected]
    if start is None:
        starts.append(_minimise(expected, SCALE, strokes, grid, prior)[0])
    press, _ = min((_minimise(begin, ALL, strokes, grid, prior) for begin in starts), key=itemgetter(1))
    return fit_residual(press, strokes, grid) if residual else press


@dataclass(frozen=True, slots=True)
class Drawn:
    """A press as a brush predicts it, with the derivatives by its parameters over their spreads.

    A parameter moves the two edges of the mark, and the ink of a pixel depends only on the edge on its side. So the
    Jacobian J of the image is d ink / d edge, one image, times the derivatives of the edges, and J'J and J'r are sums
    over columns. Matrices of that size are also too small for a matrix library to start threads for them.
    """

    ink: Floats
    """Probability of ink (len(y_mm), len(x_mm))."""
    by_edge: Floats
    """Its derivative by the edge on the pixel's side, 1/mm."""
    above: NDArray[np.bool_]
    """Rows (len(y_mm),) on the upper side."""
    edges: Floats
    """Derivatives of the edges by P parameters, (P, 2 len(x_mm)): the upper edge, then the lower, mm."""

    def square(self) -> Floats:
        """J'J, (P, P)."""
        return (self.edges * self._by_side(self.by_edge**2)) @ self.edges.T

    def pull(self, residual: Floats) -> Floats:
        """J'r, (P,), of an image's residual r."""
        return self.edges @ self._by_side(self.by_edge * residual)

    def _by_side(self, image: Floats) -> Floats:
        """Sums of an image over each side's rows, (2 len(x_mm),)."""
        return np.concatenate([image[self.above].sum(axis=0), image[~self.above].sum(axis=0)])


def draw(press: FittedPress, depth_mm: float, tilt_deg: float, grid: Grid, free: Sequence[int] = ALL) -> Drawn:
    """Draw a press with its derivatives by the free parameters; the edges are moved by a small step of each."""
    values = press.values + STEP * np.diag(spreads())[list(free)]
    values = np.concatenate([press.values[None], values])
    edges = replace(press, values=values).edges_at(depth_mm, tilt_deg, grid.x_mm)
    ink = chance_within(edges[0], grid.y_mm, SPREAD_MM)
    moved = (edges[1:] - edges[0]) / STEP
    return Drawn(ink, ink * (1.0 - ink) / SPREAD_MM, grid.y_mm > 0.0, moved.reshape(len(free), -1))


def _minimise(
    press: FittedPress, free: Sequence[int], strokes: Sequence[Pressed], grid: Grid, prior: Prior
) -> tuple[FittedPress, float]:
    """Levenberg-Marquardt from `press`, and the cost where it ends; a parameter one standard deviation off the prior
    costs as much as a pixel of wrong ink."""
    if not strokes:
        raise ValueError("a fit needs at least one stroke")
    at = list(free)
    low, high = (np.array([getattr(PARAMETERS[k], end) for k in at]) for end in ("low", "high"))

    def at_values(vector: Floats) -> FittedPress:
        values = press.values.copy()
        values[at] = vector
        return replace(press, values=values)

    def equations(vector: Floats) -> Equations:
        trial = at_values(vector)
        squares, gradients, cost = _normal(trial, at, strokes, grid)
        pull = prior.precision @ prior.off(trial.values)
        cost += 0.5 * float(prior.off(trial.values) @ pull)
        square = squares.sum(axis=0) + prior.precision[np.ix_(at, at)]
        gradient = gradients.sum(axis=0) + pull[at]
        # A parameter that is pulled beyond its bound stays there: the step of the others must not count on it.
        held = ((vector <= low) & (gradient > 0.0)) | ((vector >= high) & (gradient < 0.0))
        square[held], square[:, held], gradient[held] = 0.0, 0.0, 0.0
        square[held, held] = 1.0
        return Equations(cost, square, gradient)

    def feasible(vector: Floats) -> Floats | None:
        """Within the bounds; None if a press would not reach the paper."""
        clipped = np.clip(vector, low, high)
        h0_mm = at_values(clipped).values[NAMES.index("h0_mm")]
        return None if any(s.depth_mm + h0_mm <= 0.1 for s in strokes) else clipped

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
    press: FittedPress, at: Sequence[int], strokes: Sequence[Pressed], grid: Grid
) -> tuple[Floats, Floats, float]:
    """J'J (P, P) and J'r (P,) of each stroke by the P parameters `at`, and half the sum of squares.

    Strays are integrated out. A cell is drawn once for all its strokes.
    """
    strays = [NAMES.index(name) for name in STRAYS]
    sizes = np.array(list(STRAYS.values())) / spreads()[strays]
    free = sorted({*at, *strays})
    stray, kept = ([free.index(k) for k in chosen] for chosen in (strays, at))
    drawn: dict[tuple[float, float], tuple[Drawn, Floats, Floats, Floats]] = {}
    squares: list[Floats] = []
    gradients: list[Floats] = []
    cost = 0.0
    for stroke in strokes:
        cell = (stroke.depth_mm, stroke.tilt_deg)
        if cell not in drawn:
            mark = draw(press, *cell, grid, free)
            square = mark.square()
            inverse = np.asarray(np.linalg.inv(square[np.ix_(stray, stray)] + np.diag(sizes**-2.0)), np.float64)
            taken = inverse @ square[stray]
            drawn[cell] = mark, square - square[:, stray] @ taken, taken, inverse
        mark, square, taken, inverse = drawn[cell]
        miss = mark.ink - stroke.ink
        pull = mark.pull(miss)
        squares.append(square[np.ix_(kept, kept)])
        gradients.append((pull - taken.T @ pull[stray])[kept])
        cost += 0.5 * float(np.vdot(miss, miss) - pull[stray] @ inverse @ pull[stray])
    return np.array(squares), np.array(gradients), cost


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
