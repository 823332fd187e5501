"""Staged least squares of `model.fitted` on coverage images, with a condition number for each stage. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.fitted import MODES, NAMES, PARAMETERS, FittedPress, chance_within, command_terms, modes
from sessions.progress import Progress, counted, unseen

Floats = NDArray[np.float64]

SPREAD_MM = 0.15
"""Variation of an edge from press to press (scale of a logistic)."""
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
WORST_CONDITION = 300.0
"""Condition number of the Jacobian with unit columns above which noisy captures do not separate the parameters."""
ROUNDS = 40
STEP = 1e-4
"""Step of a derivative, as a share of the parameter's spread."""
EDGE_SPREAD_MM = (1.2, 0.4, 0.3, 0.15, 0.15)
"""Expected size of an edge's terms; for the k-th sine it falls as 1 / k."""
EDGE_NOISE_MM = 0.25


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixel centres of an image around the point of touch, mm: x toward the heel, y upward."""

    x_mm: Floats
    y_mm: Floats

    @property
    def px_mm(self) -> float:
        """The pixel's side."""
        return float(self.x_mm[1] - self.x_mm[0])


@dataclass(frozen=True, slots=True)
class Pressed:
    """One captured press: its command and its ink, (len(y_mm), len(x_mm)) from 0 to 1."""

    height_mm: float
    tilt_deg: float
    ink: NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class Stage:
    """The outcome of one stage."""

    name: str
    parameters: tuple[str, ...]
    condition: float
    """Condition number over all free parameters; inf where a column of the Jacobian is zero."""
    refused: bool


@dataclass(frozen=True, slots=True)
class Fit:
    """A brush fitted to presses, with the data for its intervals and for the choice of the next press."""

    press: FittedPress
    free: tuple[str, ...]
    stages: tuple[Stage, ...]
    squares: Floats
    """(strokes, P, P): J'J of each stroke at the end, scaled by the parameters' spreads; P is free parameters."""
    gradients: Floats
    """(strokes, P)."""
    strokes: int


def fit_presses(
    strokes: Sequence[Pressed],
    grid: Grid,
    radius_mm: float,
    length_mm: float,
    *,
    edges: bool = True,
    stages: Sequence[tuple[str, tuple[str, ...]]] = STAGES,
    progress: Progress = unseen,
) -> Fit:
    """Fit all stages that the strokes determine, then the edges. Raises ValueError without a stroke."""
    if not strokes:
        raise ValueError("a fit needs at least one stroke")
    press = FittedPress(radius_mm, length_mm)
    free: tuple[str, ...] = ()
    made: list[Stage] = []
    for name, parameters in counted(stages, "stages fitted", len(stages), progress):
        wanted = (*free, *parameters)
        # Judged at the end of the stage's fit, as the published start is far from any brush.
        fitted = _minimise(press, wanted, strokes, grid)
        condition = condition_number(_normal(fitted, wanted, strokes, grid)[0].sum(axis=0))
        refused = not condition <= WORST_CONDITION
        made.append(Stage(name, parameters, condition, refused))
        if not refused:
            press, free = fitted, wanted
    squares, gradients, _ = _normal(press, free, strokes, grid)
    if edges:
        press = replace(press, edges=fit_edges(press, strokes, grid))
    return Fit(press, free, tuple(made), squares, gradients, len(strokes))


def refit(fit: Fit, strokes: Sequence[Pressed], grid: Grid) -> Fit:
    """Fit the same parameters to other strokes of the same brush, starting from the fit.

    Raises ValueError as `fit_presses`.
    """
    if not strokes:
        raise ValueError("a fit needs at least one stroke")
    bare = replace(fit.press, edges=FittedPress(fit.press.radius_mm, fit.press.length_mm).edges)
    press = _minimise(bare, fit.free, strokes, grid)
    squares, gradients, _ = _normal(press, fit.free, strokes, grid)
    press = replace(press, edges=fit_edges(press, strokes, grid))
    return replace(fit, press=press, squares=squares, gradients=gradients, strokes=len(strokes))


def zero_touch(press: FittedPress, strokes: Sequence[Pressed], grid: Grid) -> tuple[FittedPress, Floats]:
    """Fit only depth and place of the zero touch, all else of the brush held: what changed since `press` was fitted.

    Returns the brush and the standard errors of (h0_mm, origin_mm), by bootstrap over strokes.
    """
    free = ("h0_mm", "origin_mm")
    edges = press.edges
    held = _minimise(replace(press, edges=np.zeros_like(edges)), free, strokes, grid)
    squares, gradients, _ = _normal(held, free, strokes, grid)
    errors = bootstrap(held, free, squares, gradients).std(axis=0)
    return replace(held, edges=edges), errors


def bootstrap(
    press: FittedPress, free: Sequence[str], squares: Floats, gradients: Floats, draws: int = 500, seed: int = 0
) -> Floats:
    """(draws, P) values of the free parameters, by bootstrap over strokes.

    Each draw takes one Gauss-Newton step from the fit instead of a whole fit, which keeps 500 of them within a
    second; with fewer than some 8 strokes the intervals are too short.
    """
    at = [NAMES.index(name) for name in free]
    spread = np.array([PARAMETERS[k].spread for k in at])
    off = (press.values[at] - np.array([PARAMETERS[k].start for k in at])) / spread
    count = len(squares)
    weights = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), draws).astype(np.float64)
    square = np.tensordot(weights, squares, 1) + np.eye(len(at))
    steps = np.asarray(np.linalg.solve(square, -(weights @ gradients + off)[..., None]), np.float64)[..., 0]
    low, high = (np.array([getattr(PARAMETERS[k], end) for k in at]) for end in ("low", "high"))
    return np.clip(press.values[at] + spread * steps, low, high)


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


def fit_edges(press: FittedPress, strokes: Sequence[Pressed], grid: Grid) -> Floats:
    """(2, MODES, TERMS) deviations of the captured edges from the profile, by ridge regression."""
    weights = np.outer(1.0 / np.arange(1, MODES + 1), EDGE_SPREAD_MM).ravel()
    square = np.eye(len(weights))
    right = np.zeros((len(weights), 2))
    above = grid.y_mm > 0.0
    for stroke in strokes:
        s = press.sizes(stroke.height_mm, stroke.tilt_deg)
        share = (grid.x_mm - s.widest + s.tip) / (s.tip + s.heel)
        on = (share > 0.0) & (share < 1.0)
        design = np.einsum("xk,t->xkt", modes(share[on]), command_terms(stroke.height_mm, stroke.tilt_deg))
        design = design.reshape(int(on.sum()), -1) * weights / EDGE_NOISE_MM
        width = press.half_width(stroke.height_mm, stroke.tilt_deg, grid.x_mm[on])
        square += design.T @ design
        for side, rows in enumerate((above, ~above)):
            edge = stroke.ink[rows][:, on].sum(axis=0) * grid.px_mm
            right[:, side] += design.T @ ((edge - width) / EDGE_NOISE_MM)
    return (np.linalg.solve(square, right) * weights[:, None]).T.reshape(2, MODES, -1)


def _minimise(press: FittedPress, free: tuple[str, ...], strokes: Sequence[Pressed], grid: Grid) -> FittedPress:
    """Levenberg-Marquardt from `press`; a parameter one spread from its start costs as much as a pixel of wrong ink."""
    at = [NAMES.index(name) for name in free]
    spread = np.array([PARAMETERS[k].spread for k in at])
    start = np.array([PARAMETERS[k].start for k in at])
    low, high = (np.array([getattr(PARAMETERS[k], end) for k in at]) for end in ("low", "high"))

    def equations(trial: FittedPress) -> tuple[float, Floats, Floats]:
        squares, gradients, cost = _normal(trial, free, strokes, grid)
        off = (trial.values[at] - start) / spread
        return cost + 0.5 * float(off @ off), squares.sum(axis=0) + np.eye(len(at)), gradients.sum(axis=0) + off

    cost, square, gradient = equations(press)
    damping = 1e-2
    for _ in range(ROUNDS):
        step = np.linalg.solve(square + damping * np.diag(np.diag(square)), -gradient)
        values = press.values.copy()
        values[at] = np.clip(values[at] + spread * np.clip(step, -1.0, 1.0), low, high)
        trial = replace(press, values=values)
        if any(s.height_mm + values[1] <= 0.1 for s in strokes):
            damping *= 8.0
            continue
        found = equations(trial)
        if found[0] < cost:
            gain = (cost - found[0]) / max(cost, 1e-9)
            press, (cost, square, gradient), damping = trial, found, max(damping / 6.0, 1e-7)
            if gain < 1e-4:
                break
        else:
            damping *= 8.0
            if damping > 1e5:
                break
    return press


def _normal(
    press: FittedPress, free: Sequence[str], strokes: Sequence[Pressed], grid: Grid
) -> tuple[Floats, Floats, float]:
    """J'J and J'r of each stroke, and half the sum of squares. A cell is drawn once for all its strokes."""
    drawn: dict[tuple[float, float], tuple[Drawn, Floats]] = {}
    squares: list[Floats] = []
    gradients: list[Floats] = []
    cost = 0.0
    for stroke in strokes:
        cell = (stroke.height_mm, stroke.tilt_deg)
        if cell not in drawn:
            made = draw(press, free, *cell, grid)
            drawn[cell] = made, made.square()
        made, square = drawn[cell]
        miss = made.ink - stroke.ink
        squares.append(square)
        gradients.append(made.pull(miss))
        cost += 0.5 * float(np.vdot(miss, miss))
    return np.array(squares), np.array(gradients), cost
