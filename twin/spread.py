"""Fit of how presses of one cell differ: spread, reach and bow of the tip, place of the mark, and stray of the hairs.

Five statistics of repeats, five constants. Simulated presses have the same seeds for every brush tried.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.score import csim
from brushloop.calibrate.fit.captures import Grid
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.twin.constants import SPREAD, Offset, Vector, with_values
from brushloop.twin.drawing import Cell, Images, draw
from brushloop.twin.shape import Map, derivatives

FEWEST_REPEATS = 3
"""Captures of a cell from which their spread is told."""
REPEATS = 6
"""Simulated presses of a cell."""
FIRST_SEED = 500
END_SHARE = 1.0 / 3.0
"""Share of the mark whose middle measures the bow, from its tip, or the place, from its other end."""
START = tuple(0.5 if one.name == "place_wander_mm" else 0.0 for one in SPREAD)
"""Where the search starts, in scales: a place that wanders by 0 is a bad start, where deviations do not yet rise."""
PRIOR_SD = 2.0
STEP = 0.3
STEPS = 6
AGREEMENT_SD = 0.05
"""Relative standard error of the disagreement of repeats, 1 - CSIM. It averages over the whole edge of each mark, so it
is better known than the four deviations, each of one number a mark: without one repeat of four it changes by 3 %."""


@dataclass(frozen=True, slots=True)
class Repeats:
    """The cells with several captures, and their ink, (n, len(y_mm), len(x_mm)) each."""

    cells: tuple[Cell, ...]
    ink: tuple[Images, ...]

    @property
    def freedom(self) -> int:
        """Degrees of freedom of a deviation pooled over the cells."""
        return sum(len(one) - 1 for one in self.ink)


@dataclass(frozen=True, slots=True)
class Spread:
    """The constants in scales from their defaults, their standard errors, and the agreement of repeats."""

    point: tuple[float, ...]
    error: tuple[float, ...]
    captured_percent: float
    """Mean CSIM of two captures of a cell."""
    twin_percent: float
    """The same of the twin."""


def fit_spread(
    spec: BrushSpec,
    offset: Offset,
    repeats: Repeats,
    grid: Grid,
    each: Map = map,
    start: Sequence[float] = START,
) -> Spread:
    """Match the statistics of the captures. Raises ValueError without a cell that has `FEWEST_REPEATS` captures."""
    from scipy.optimize import least_squares  # slow to import

    if not repeats.cells:
        raise ValueError(f"no cell has {FEWEST_REPEATS} captures")
    # twice the relative standard error of a deviation with this many degrees of freedom: the simulated one has its own
    deviation = 2.0 / math.sqrt(2.0 * repeats.freedom)
    sd = np.array([deviation] * 4 + [AGREEMENT_SD])
    seen = statistics(repeats.ink, grid)
    off = partial(_off, spec, offset, repeats.cells, grid, seen, sd)
    low, high = np.array([one.bounds for one in SPREAD]).T
    best = least_squares(
        off,
        start,
        jac=lambda point: derivatives(off, point, high, STEP, each),
        bounds=(low, high),
        max_nfev=STEPS,
    )
    twin = _drawn(spec, offset, repeats.cells, grid, best.x)
    jacobian = np.asarray(best.jac, np.float64)
    error = np.sqrt(np.diagonal(np.linalg.inv(jacobian.T @ jacobian)))
    return Spread(tuple(map(float, best.x)), tuple(map(float, error)), agreement(repeats.ink), agreement(twin))


def _off(
    spec: BrushSpec, offset: Offset, cells: Sequence[Cell], grid: Grid, seen: Vector, sd: Vector, point: Vector
) -> Vector:
    drawn = statistics(_drawn(spec, offset, cells, grid, point), grid)
    return np.concatenate([(drawn - seen) / sd, point / PRIOR_SD])


def _drawn(spec: BrushSpec, offset: Offset, cells: Sequence[Cell], grid: Grid, point: Vector) -> list[Images]:
    return list(draw(with_values(spec, SPREAD, point), offset, cells, grid, REPEATS, FIRST_SEED))


def statistics(ink: Sequence[Images], grid: Grid) -> Vector:
    """Logarithms of deviations between repeats and of 1 - CSIM of two of them.

    The deviations are those of log area, and in mm of the tip's x and of the y of the tip and of the heel.
    """
    measured = [np.array([_measure(image, grid) for image in cell]) for cell in ink]
    freedom = sum(len(one) - 1 for one in measured)
    squares = sum(((one - one.mean(axis=0)) ** 2).sum(axis=0) for one in measured)
    deviations = np.sqrt(np.asarray(squares) / max(freedom, 1))
    return np.log(np.append(deviations, 1.0 - agreement(ink) / 100.0) + 1e-6)


def agreement(ink: Sequence[Images]) -> float:
    """Mean CSIM in percent of two repeats of a cell, as binary images."""
    binary = [(cell > 0.5).astype(np.float32) for cell in ink]
    pairs = [csim(a, b) for cell in binary for a, b in combinations(cell, 2)]
    return 100.0 * float(np.mean(pairs))


def _measure(image: Images, grid: Grid) -> tuple[float, float, float, float]:
    ink = image > 0.5
    columns = np.flatnonzero(ink.any(axis=0))
    if not columns.size:
        return 0.0, 0.0, 0.0, 0.0
    first, last = int(columns[0]), int(columns[-1])
    share = max(1, round(END_SHARE * (last - first + 1)))
    tip, heel = (_middle_mm(end, grid) for end in (ink[:, first : first + share], ink[:, last + 1 - share : last + 1]))
    return math.log(float(ink.sum())), float(grid.x_mm[first]), tip, heel


def _middle_mm(ink: NDArray[np.bool_], grid: Grid) -> float:
    """The mean y of the ink."""
    return float((ink.sum(axis=1) * grid.y_mm).sum() / ink.sum())
