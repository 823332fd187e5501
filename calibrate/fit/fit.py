"""Least squares of `model.fitted` on coverage images with a prior. No torch.

No press repeats exactly: width, place and lengths differ from press to press, each by one amount along the whole mark.
These differences (`STRAYS`) are integrated out of the likelihood, linearised at the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.fit.captures import SPREAD_MM, Grid, Pressed, by_cell
from brushloop.calibrate.fit.prior import Prior, about, learned, spreads
from brushloop.calibrate.fit.residual import fit_residual
from brushloop.model.damped import Damping, Equations, descend
from brushloop.model.fitted import NAMES, PARAMETERS, FittedPress, chance_within

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
TOUCH = (NAMES.index("h0_mm"), NAMES.index("origin_mm"))
"""Depth and place of the zero touch among the parameters."""


def fit_presses(
    strokes: Sequence[Pressed],
    grid: Grid,
    radius_mm: float,
    length_mm: float,
    *,
    residual: bool = True,
    prior: Prior | None = None,
) -> FittedPress:
    """Fit the parameters, then the residual that they cannot express. By default the prior is `learned`.

    The cost has several minima. Of two descents, one from the prior and one that fits size and place of the marks
    first, the lower one counts. Parameters that the strokes do not determine have the values that the prior expects.
    Raises ValueError without a stroke.
    """
    prior = learned() if prior is None else prior
    expected = FittedPress(radius_mm, length_mm, prior.values)
    sized, _ = _minimise(expected, SCALE, strokes, grid, prior)
    descents = [_minimise(start, ALL, strokes, grid, prior) for start in (expected, sized)]
    press, _ = min(descents, key=itemgetter(1))
    return fit_residual(press, strokes, grid) if residual else press


def zero_touches(press: FittedPress, strokes: Sequence[Pressed], grid: Grid) -> Floats:
    """How far depth and place of the zero touch lie from those of an earlier fit, with all else of it held.

    (cells, 2) mm, for each depth and tilt of the strokes on its own.
    """
    touches: list[Floats] = []
    for held in by_cell(strokes).values():
        moved, _ = _minimise(press, TOUCH, held, grid, about(press.values))
        touches.append((moved.values - press.values)[list(TOUCH)])
    return np.array(touches)


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
        h0_mm = at_values(clipped).values[TOUCH[0]]
        return None if any(s.depth_mm + h0_mm <= 0.1 for s in strokes) else clipped

    found = descend(
        equations,
        press.values[at],
        rounds=ROUNDS,
        most=1.0,
        gain=1e-4,
        scale=spreads()[at],
        damping=DAMPING,
        feasible=feasible,
    )
    return at_values(found.vector), found.at.cost


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
