"""Least squares of `model.fitted` on coverage images with a prior, and a condition number for each stage. No torch.

No press repeats exactly: width, place and lengths differ from press to press, each by one amount along the whole mark.
These differences (`STRAYS`) are integrated out of the likelihood, linearised at the fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.fit.captures import SPREAD_MM, Grid, Pressed
from calibrate.fit.prior import Prior, learned, spreads, wide
from calibrate.fit.residual import fit_residual
from model.damped import Damping, Equations, descend
from model.fitted import NAMES, PARAMETERS, FittedPress, chance_within, published
from sessions.progress import Progress, counted, unseen

Floats = NDArray[np.float64]

STAGES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("scale and place", ("lam", "tip_gain", "origin_mm")),
    ("heel", ("heel_gain",)),
    ("zero offset", ("h0_mm", "origin_gain")),
    ("profile", ("heel_power", "heel_round", "tip_power", "tip_round", "core_mm")),
    ("growth", ("width_power", "length_power")),
    ("tilt", ("width_tilt", "length_tilt")),
    ("lean", ("lean", "heel_tilt")),
)
"""Each stage frees its parameters in addition to all that were freed before."""
ROUNDS = 40
DAMPING = Damping(1e-2, 6.0, 8.0, 1e-7, 1e5, floor=0.0)
STEP = 1e-4
"""Step of a derivative, as a share of the parameter's spread."""
STRAYS = {"lam": 0.09, "origin_mm": 0.3, "heel_gain": 0.3, "tip_gain": 0.04}
"""Standard deviations by which single presses of a brush differ: about 5 % of width and lengths, 0.3 mm of place."""


@dataclass(frozen=True, slots=True)
class Stage:
    """The outcome of one stage."""

    name: str
    parameters: tuple[str, ...]
    condition: float
    """Condition number of the Jacobian with unit columns over all free parameters; inf where a column is zero."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A brush fitted to presses, and how well the strokes determine its parameters."""

    press: FittedPress
    free: tuple[str, ...]
    stages: tuple[Stage, ...]
    information: Floats
    """(P, P): sum of J'J over the strokes, scaled by the parameters' spreads; P is free parameters."""
    prior: Prior
    strokes: int

    @property
    def errors(self) -> Floats:
        """Standard deviation of each free parameter after the fit, (P,), in the parameter's unit.

        The posterior is linearised at the fit, with a variance of 1 for a pixel's edge times the number of pixels whose
        errors are correlated. What the strokes do not determine keeps the deviation of the prior.
        """
        at = [NAMES.index(name) for name in self.free]
        return spreads()[at] * np.sqrt(np.diag(_inverse(self.information + self.prior.precision[np.ix_(at, at)])))

    @property
    def from_strokes(self) -> Floats:
        """Share of each free parameter's prior variance that the strokes removed, (P,), 0 to 1."""
        at = [NAMES.index(name) for name in self.free]
        before = np.diag(_inverse(self.prior.precision[np.ix_(at, at)]))
        return 1.0 - (self.errors / spreads()[at]) ** 2 / before


def fit_presses(
    strokes: Sequence[Pressed],
    grid: Grid,
    radius_mm: float,
    length_mm: float,
    *,
    residual: bool = True,
    stages: Sequence[tuple[str, tuple[str, ...]]] = STAGES,
    prior: Prior | None = None,
    progress: Progress = unseen,
) -> Fit:
    """Fit the parameters of the stages, then the residual that they cannot express. By default the prior is `learned`.

    Parameters that the strokes do not determine have the values and the deviations that the prior expects.
    Raises ValueError without a stroke.
    """
    if not strokes:
        raise ValueError("a fit needs at least one stroke")
    prior = learned() if prior is None else prior
    press = FittedPress(radius_mm, length_mm, prior.values)
    free: tuple[str, ...] = ()
    made: list[Stage] = []
    if not prior.gradual:
        press = _minimise(press, tuple(name for _, names in stages for name in names), strokes, grid, prior)
    for name, parameters in counted(stages, "stages fitted", len(stages), progress):
        free = (*free, *parameters)
        if prior.gradual:
            press = _minimise(press, free, strokes, grid, prior)
        made.append(Stage(name, parameters, condition_number(_squares(press, free, strokes, grid))))
    information = _normal(press, free, strokes, grid)[0].sum(axis=0)
    if residual:
        press = fit_residual(press, strokes, grid)
    return Fit(press, free, tuple(made), information, prior, len(strokes))


def refit(press: FittedPress, strokes: Sequence[Pressed], grid: Grid) -> FittedPress:
    """Fit other strokes of the same brush, starting from `press`. Raises ValueError as `fit_presses`."""
    if not strokes:
        raise ValueError("a fit needs at least one stroke")
    bare = FittedPress(press.radius_mm, press.length_mm, press.values)
    return fit_residual(_minimise(bare, NAMES, strokes, grid, learned()), strokes, grid)


def zero_touch(press: FittedPress, strokes: Sequence[Pressed], grid: Grid) -> tuple[FittedPress, Floats]:
    """Fit only depth and place of the zero touch, with all other parameters held, to see how they changed.

    Returns the brush and the standard deviations of (h0_mm, origin_mm).
    """
    free = ("h0_mm", "origin_mm")
    bare = FittedPress(press.radius_mm, press.length_mm, press.values)
    held = _minimise(bare, free, strokes, grid, wide())
    information = _normal(held, free, strokes, grid)[0].sum(axis=0)
    found = Fit(held, free, (), information, wide(), len(strokes))
    return replace(held, edges=press.edges, ends=press.ends), found.errors


def condition_number(square: Floats) -> float:
    """Condition number of a Jacobian with unit columns, from its J'J; inf where a column is zero."""
    length = np.sqrt(np.diag(square))
    if not len(square) or not np.all(length > 1e-6):
        return float("inf")
    values = np.linalg.eigvalsh(square / np.outer(length, length))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 1e-12 else float("inf")


@dataclass(frozen=True, slots=True)
class Drawn:
    """A press as a brush predicts it, with the derivatives by its free parameters over their spreads.

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
    """Derivatives of the edges, (P, 2 len(x_mm)): the upper edge, then the lower, mm."""

    def square(self) -> Floats:
        """J'J, (P, P)."""
        return (self.edges * self._by_side(self.by_edge**2)) @ self.edges.T

    def pull(self, residual: Floats) -> Floats:
        """J'r, (P,), of an image's residual r."""
        return self.edges @ self._by_side(self.by_edge * residual)

    def _by_side(self, image: Floats) -> Floats:
        """Sums of an image over each side's rows, (2 len(x_mm),)."""
        return np.concatenate([image[self.above].sum(axis=0), image[~self.above].sum(axis=0)])


def draw(press: FittedPress, free: Sequence[str], height_mm: float, tilt_deg: float, grid: Grid) -> Drawn:
    """Draw a press with its derivatives; the edges are moved by a small step of each free parameter."""
    at = [NAMES.index(name) for name in free]
    values = np.tile(press.values, (len(free) + 1, 1))
    values[range(1, len(values)), at] += [STEP * PARAMETERS[k].spread for k in at]
    edges = replace(press, values=values).edges_at(height_mm, tilt_deg, grid.x_mm)
    ink = chance_within(edges[0], grid.y_mm, SPREAD_MM)
    moved = (edges[1:] - edges[0]) / STEP
    return Drawn(ink, ink * (1.0 - ink) / SPREAD_MM, grid.y_mm > 0.0, moved.reshape(len(free), -1))


def _minimise(
    press: FittedPress, free: tuple[str, ...], strokes: Sequence[Pressed], grid: Grid, prior: Prior
) -> FittedPress:
    """Levenberg-Marquardt from `press`; a parameter one standard deviation off the prior costs as much as a pixel of
    wrong ink."""
    at = [NAMES.index(name) for name in free]
    spread = spreads()[at]
    low, high = (np.array([getattr(PARAMETERS[k], end) for k in at]) for end in ("low", "high"))

    def at_values(vector: Floats) -> FittedPress:
        values = press.values.copy()
        values[at] = vector
        return replace(press, values=values)

    def equations(vector: Floats) -> Equations:
        trial = at_values(vector)
        squares, gradients, cost = _normal(trial, free, strokes, grid)
        pull, stiff = _prior_terms(trial, at, prior)
        off = _off(trial, prior)
        cost += 0.5 * float(off @ prior.precision @ off)
        return Equations(cost, squares.sum(axis=0) + stiff, gradients.sum(axis=0) + pull)

    def feasible(vector: Floats) -> Floats | None:
        """Within the bounds; None if a press would not reach the paper."""
        clipped = np.clip(vector, low, high)
        h0_mm = at_values(clipped).values[1]
        return None if any(s.height_mm + h0_mm <= 0.1 for s in strokes) else clipped

    found = descend(
        equations,
        press.values[at],
        rounds=ROUNDS,
        most=1.0,
        gain=1e-4,
        scale=spread,
        damping=DAMPING,
        feasible=feasible,
    )
    return at_values(found.vector)


def _inverse(square: Floats) -> Floats:
    return np.asarray(np.linalg.inv(square), np.float64)


def _squares(press: FittedPress, free: Sequence[str], strokes: Sequence[Pressed], grid: Grid) -> Floats:
    """J'J of all strokes without strays, (P, P)."""
    cells = Counter((stroke.height_mm, stroke.tilt_deg) for stroke in strokes)
    return np.sum([count * draw(press, free, *cell, grid).square() for cell, count in cells.items()], axis=0)


def _off(press: FittedPress, prior: Prior) -> Floats:
    """Distance of the parameters from the prior's mean, over their spreads, (17,)."""
    return (press.values - published()) / spreads() - prior.mean


def _prior_terms(press: FittedPress, at: Sequence[int], prior: Prior) -> tuple[Floats, Floats]:
    """Gradient and second derivative of the prior's cost by the parameters `at`, the others held."""
    return (prior.precision @ _off(press, prior))[at], prior.precision[np.ix_(at, at)]


def _normal(
    press: FittedPress, free: Sequence[str], strokes: Sequence[Pressed], grid: Grid
) -> tuple[Floats, Floats, float]:
    """J'J and J'r of each stroke, and half the sum of squares, its strays integrated out.

    A cell is drawn once for all its strokes.
    """
    stray = [k for k, name in enumerate(free) if name in STRAYS]
    sizes = np.array([STRAYS[free[k]] / PARAMETERS[NAMES.index(free[k])].spread for k in stray])
    drawn: dict[tuple[float, float], tuple[Drawn, Floats, Floats, Floats]] = {}
    squares: list[Floats] = []
    gradients: list[Floats] = []
    cost = 0.0
    for stroke in strokes:
        cell = (stroke.height_mm, stroke.tilt_deg)
        if cell not in drawn:
            made = draw(press, free, *cell, grid)
            square = made.square()
            inverse = np.asarray(np.linalg.inv(square[np.ix_(stray, stray)] + np.diag(sizes**-2.0)), np.float64)
            taken = inverse @ square[stray]
            drawn[cell] = made, square - square[:, stray] @ taken, taken, inverse
        made, square, taken, inverse = drawn[cell]
        miss = made.ink - stroke.ink
        pull = made.pull(miss)
        squares.append(square)
        gradients.append(pull - taken.T @ pull[stray])
        cost += 0.5 * float(np.vdot(miss, miss) - pull[stray] @ inverse @ pull[stray])
    return np.array(squares), np.array(gradients), cost
