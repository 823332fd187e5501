"""The searches of a twin, all by least squares with brushes that press with the same seeds.

Mechanics, ink and place are fitted to the mean press of each condition, on blurred images: a wide blur gives the search
a slope from far away, a narrow one the detail. The minimiser is SciPy's trust region with bounds; its derivatives are
differences between brushes. A wide prior on each constant keeps what the presses do not determine near its default.

How presses of one condition differ is fitted to five statistics of repeats: spread, reach and bow of the tip, place of
the mark, and stray of the hairs.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, count

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.work import Store, key_of
from brushloop.drivers.sim.brush.misfit import Misfit
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.model.presses import DepthTilt, Grid
from brushloop.model.similarity import csim
from brushloop.sessions.terminal import Progress
from brushloop.twin.brush import LEAST, MOST, SHAPE, SPREAD, STILL, Images, Place, Vector, draw, place_at, with_values

IMAGE_SD = 0.3
"""Standard deviation that the fit assumes for a blurred pixel. It is large because neighbouring pixels deviate
together, and because a brush of other physics must not pull constants away from their prior: the misfit takes up what
they cannot express. It was chosen on both bristle brushes: with 0.12, the second one's twin was 0.6 points worse."""
PRIOR_SD = 2.5
"""Standard deviation of the prior, in scales; wide, because a brush of another make differs by several scales."""
STEP = 0.3
"""Scales by which a constant is changed for its derivative."""
EVERY = 2
"""Blurred images are compared at each second row and column."""
NEAR_BOUND = 1e-3
STARTS = {"trail_share": 0.25}
"""Values from which the search starts where the default is a bad place: under a full trail, its share has no effect."""
INDIVIDUAL = 1000
"""Seed of the twin's own hairs. Those of a captured brush are not known, and no brush of a bench has this seed."""
MOST_TRIALS = 4
"""Brushes tried for each step: one that is not nearer to the captures costs little beside the derivatives."""
FTOL = 3e-4
"""A step that brings the sum of squares down by less than this share is the last of its pass."""
FEWEST_REPEATS = 3
"""Fewest captures of a condition from which their spread is estimated."""
REPEATS = 6
"""Simulated presses of a condition."""
FIRST_SEED = 500
END_SHARE = 1.0 / 3.0
"""Share of the mark whose middle measures the bow, from its tip, or the place, from its other end."""
SPREAD_START = tuple(0.5 if one.name == "place_wander_mm" else 0.0 for one in SPREAD)
"""Where the search starts, in scales: a place that wanders by 0 is a bad start, where deviations do not yet rise."""
SPREAD_PRIOR_SD = 2.0
SPREAD_STEPS = 6
AGREEMENT_SD = 0.05
"""Relative standard error of the disagreement of repeats, 1 - CSIM. It averages over the whole edge of each mark, so it
is better known than the four deviations, each of one number a mark: without one repeat of four it changes by 3 %."""
COARSE_MM = (1.2, 0.5)
"""Blurs of the first passes of the search."""
FINE_MM = 0.3
"""Blur of the last pass."""
STEPS = 6
"""Largest number of steps of a pass, each with derivatives of its own."""


@dataclass(frozen=True, slots=True)
class Target:
    """What a twin is fitted to."""

    base: BrushSpec
    """Radius and length of the brush; everything else at its default."""
    conditions: tuple[DepthTilt, ...]
    grid: Grid
    mean: Images
    """(conditions, len(y_mm), len(x_mm)) mean ink of each condition's captures."""

    def brush(self, point: Vector) -> BrushSpec:
        """The brush at a point of the search."""
        return with_values(self.base, SHAPE, point)

    def only(self, kept: Sequence[int]) -> Target:
        """The same with some of the conditions."""
        return replace(self, conditions=tuple(self.conditions[k] for k in kept), mean=self.mean[list(kept)])


def start() -> Vector:
    """The default brush, but with a trail faint enough for the search to see whether there is more of it or less."""
    scales = [one.scales(STARTS.get(one.name, one.default)) for one in SHAPE]
    return np.array([*scales, 0.0, 0.0, 0.0])


def off(target: Target, blur_mm: float, point: Vector) -> Vector:
    """Residuals: differences of blurred pixels between brush and captures over `IMAGE_SD`, then those of the prior."""
    still = replace(target.brush(point), **STILL)
    drawn = draw(still, place_at(point), target.conditions, target.grid)[:, 0]
    sigma = blur_mm / target.grid.px_mm
    apart = [cv2.GaussianBlur(image, (0, 0), sigma)[::EVERY, ::EVERY] for image in drawn - target.mean]
    return np.concatenate([np.asarray(apart, np.float64).ravel() / IMAGE_SD, point / PRIOR_SD])


def search(target: Target, point: Vector, workers: Executor, blur_mm: float) -> Vector:
    """One pass, starting from `point`."""
    from scipy.optimize import least_squares  # slow to import

    began = np.clip(point, LEAST + NEAR_BOUND, MOST - NEAR_BOUND)
    reached, residuals = [began], partial(off, target, blur_mm)

    def slopes(moved: Vector) -> NDArray[np.float64]:
        reached.append(began + moved)
        if len(reached) > STEPS + 1:
            raise _EnoughSteps
        return derivatives(residuals, reached[-1], MOST, workers)

    # the search is for the way from where it began, because the minimiser's first step is as long as its start is far
    # from 0, and 1 if that is 0
    with contextlib.suppress(_EnoughSteps):
        best = least_squares(
            lambda moved: residuals(began + moved),
            np.zeros_like(began),
            jac=slopes,
            bounds=(LEAST - began, MOST - began),
            max_nfev=MOST_TRIALS * STEPS,
            xtol=1e-3,
            ftol=FTOL,
            gtol=None,
        )
        reached.append(began + np.asarray(best.x, np.float64))
    return reached[-1]


class _EnoughSteps(Exception):
    """The pass has taken its steps; the point of the last one is the best so far."""


def derivatives(
    evaluate: Callable[[Vector], Vector], point: Vector, high: Vector, workers: Executor
) -> NDArray[np.float64]:
    """(residuals, constants) by differences of one step, downward where the upper bound is nearer than that."""
    steps = np.where(point + STEP < high, STEP, -STEP)
    here, *there = workers.map(evaluate, [point, *(point + np.diag(steps))])
    return np.column_stack([(one - here) / by for one, by in zip(there, steps, strict=True)])


@dataclass(frozen=True, slots=True)
class Searches:
    """The searches of one twin; passes that the store holds, as those of an interrupted run, are not repeated."""

    pool: Executor
    store: Store | None
    progress: Progress
    many: int
    """Number of searches, each with a coarse and a fine part."""
    _done: Iterator[int] = field(default_factory=lambda: count(1))

    def coarse(self, target: Target) -> Vector:
        """From the default brush to where the detail decides."""
        point = start()
        for blur_mm in COARSE_MM:
            point = self.descend(target, point, blur_mm)
        return point

    def descend(self, target: Target, point: Vector, blur_mm: float) -> Vector:
        """One pass from `point`; one that the store holds is not repeated."""
        place = target.grid.x_mm, target.grid.y_mm, target.mean
        key = key_of("twin", made_by(), blur_mm, target.base, target.conditions, *place, point)
        if self.store is not None and (kept := self.store.get(key)) is not None:
            reached = kept["point"]
        else:
            reached = search(target, point, self.pool, blur_mm)
            if self.store is not None:
                self.store.put(key, {"point": reached})
        self.progress("twin: passes of the search", next(self._done), self.many * (1 + len(COARSE_MM)))
        return reached


def covariance(target: Target, point: Vector, workers: Executor) -> NDArray[np.float64]:
    """Covariance (constants, constants) of the point in scales, clustered by condition.

    The sandwich of a least-squares fit: what each condition asks to be changed, the model's own errors included,
    spreads over the conditions. The prior counts as one more observation of each constant.
    """
    evaluate = partial(off, target, FINE_MM)
    jacobian = derivatives(evaluate, point, MOST, workers)
    residual = evaluate(point)
    count, constants = len(target.conditions), len(point)
    of_cells = jacobian[:-constants].reshape(count, -1, constants)
    pulls = np.einsum("cij,ci->cj", of_cells, residual[:-constants].reshape(count, -1))
    pulls -= pulls.mean(axis=0)
    spread = pulls.T @ pulls * count / max(count - 1, 1)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    return np.asarray(inverse @ (spread + np.eye(constants) / PRIOR_SD**2) @ inverse, np.float64)


def of_parts(points: Sequence[Vector]) -> Vector | float:
    """Variance (constants,) of the point, from the points (parts, constants) without one part of the conditions each.

    The jackknife of groups. It includes what `covariance` cannot know: that the search ended elsewhere.
    """
    if len(points) < 2:
        return 0.0
    apart = np.asarray(points) - np.mean(points, axis=0)
    return (len(points) - 1) / len(points) * (apart**2).sum(axis=0)


@dataclass(frozen=True, slots=True)
class Spread:
    """The constants in scales from their defaults, their standard errors, and the agreement of repeats."""

    point: tuple[float, ...]
    error: tuple[float, ...]
    captured_percent: float
    """Mean CSIM of two captures of a condition."""
    twin_percent: float
    """The same of the twin."""


def fit_spread(
    spec: BrushSpec,
    place: Place,
    repeats: Mapping[DepthTilt, NDArray[np.floating]],
    grid: Grid,
    workers: Executor,
    start: Sequence[float] = SPREAD_START,
    misfit: Misfit | None = None,
) -> Spread:
    """Match the statistics of the captures, (n, len(y_mm), len(x_mm)) ink of each condition."""
    from scipy.optimize import least_squares  # slow to import

    captured = list(repeats.values())
    # twice the relative standard error of a deviation with this many degrees of freedom: the simulated one has its own
    deviation = 2.0 / math.sqrt(2.0 * sum(len(one) - 1 for one in captured))
    sd = np.array([deviation] * 4 + [AGREEMENT_SD])
    drawn = partial(drawn_repeats, spec, place, tuple(repeats), grid, misfit)
    off = partial(_off_statistics, drawn, grid, statistics(captured, grid), sd)
    low, high = np.array([one.bounds for one in SPREAD]).T
    best = least_squares(
        off, start, jac=lambda point: derivatives(off, point, high, workers), bounds=(low, high), max_nfev=SPREAD_STEPS
    )
    jacobian = np.asarray(best.jac, np.float64)
    error = np.sqrt(np.diagonal(np.linalg.inv(jacobian.T @ jacobian)))
    return Spread(tuple(map(float, best.x)), tuple(map(float, error)), agreement(captured), agreement(drawn(best.x)))


def drawn_repeats(
    spec: BrushSpec,
    place: Place,
    conditions: Sequence[DepthTilt],
    grid: Grid,
    misfit: Misfit | None,
    point: Vector,
) -> list[Images]:
    """Repeats of each condition by a brush with these constants of `SPREAD`."""
    brush = with_values(spec, SPREAD, point)
    return list(draw(brush, place, conditions, grid, REPEATS, FIRST_SEED, misfit))


def _off_statistics(
    drawn: Callable[[Vector], list[Images]], grid: Grid, seen: Vector, sd: Vector, point: Vector
) -> Vector:
    return np.concatenate([(statistics(drawn(point), grid) - seen) / sd, point / SPREAD_PRIOR_SD])


def statistics(ink: Sequence[NDArray[np.floating]], grid: Grid) -> Vector:
    """Logarithms of deviations between repeats and of 1 - CSIM of two of them.

    The deviations are those of log area, and in mm of the tip's x and of the y of the tip and of the heel.
    """
    measured = [np.array([_measure(image, grid) for image in images]) for images in ink]
    freedom = sum(len(one) - 1 for one in measured)
    squares = sum(((one - one.mean(axis=0)) ** 2).sum(axis=0) for one in measured)
    deviations = np.sqrt(np.asarray(squares) / max(freedom, 1))
    return np.log(np.append(deviations, 1.0 - agreement(ink) / 100.0) + 1e-6)


def agreement(ink: Sequence[NDArray[np.floating]]) -> float:
    """Mean CSIM in percent of two repeats of a condition, as binary images."""
    binary = [(images > 0.5).astype(np.float32) for images in ink]
    pairs = [csim(a, b) for images in binary for a, b in combinations(images, 2)]
    return 100.0 * float(np.mean(pairs))


def _measure(image: NDArray[np.floating], grid: Grid) -> tuple[float, float, float, float]:
    ink = image > 0.5
    columns = np.flatnonzero(ink.any(axis=0))
    if not columns.size:
        return 0.0, 0.0, 0.0, 0.0
    first, last = int(columns[0]), int(columns[-1])
    share = max(1, round(END_SHARE * (last - first + 1)))
    ends = ink[:, first : first + share], ink[:, last + 1 - share : last + 1]
    tip, heel = (float(np.average(grid.y_mm, weights=end.sum(axis=1))) for end in ends)
    return math.log(float(ink.sum())), float(grid.x_mm[first]), tip, heel
