"""The ceiling: the score of a perfect model, that is of the best image of each cell on a fresh press of it.

Presses of a cell stray from each other. Two of them differ by the strays of both, a press and the best image only by
those of one. Strays displace the edges of a mark, and what a score loses grows with the distance between two edges. If
the strays are independent from press to press and about normal, their mean distance is sqrt 2 times that of one press
from the best image. So the ceiling is 100 - (100 - pairs) / sqrt 2, where `pairs` is the mean score of two presses of a
cell in percent: a U-statistic, which two presses of each cell suffice for. No template takes its place: one of a few
presses has strays of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.stats import Interval, interval_over_groups, summarise

Floats = NDArray[np.float64]

CEILING = "ceiling"
NEAR_POINTS = 1.5
"""Distance from the ceiling that counts as near, in points of average CSIM."""
MAX_OTHERS = 9
"""Most others that a press or a writing is compared with: all those of ten, as in the paper, or the next nine of
more."""


@dataclass(frozen=True, slots=True)
class Average:
    """The mean over presses and its 95 % interval, None where cells and presses are too few for one."""

    mean: float
    interval: Interval | None
    n: int


def others_of(press: int, count: int) -> list[int]:
    """Numbers of the presses of a cell, or writings of a character, that one of `count` is compared with."""
    return [(press + step) % count for step in range(1, min(MAX_OTHERS, count - 1) + 1)]


def pair_means(count: int, scores: Callable[[int, list[int]], Floats]) -> Floats:
    """(count, measures) mean scores of each press of one cell with the others; NaN for a single press.

    `scores` gives the (others, measures) scores of a press with others, all by their numbers.
    """
    if count < 2:
        return np.full((count, scores(0, [0]).shape[1]), np.nan)
    return np.array([scores(k, others_of(k, count)).mean(axis=0) for k in range(count)])


def ceiling_values(pairs: Floats, cells: NDArray[np.int64]) -> Floats:
    """(n,) percent, one for each press, whose mean is the ceiling; NaN for a press without another of its cell.

    `pairs` holds the mean score of each press with the others of its cell, `cells` the number of that cell. As pairs
    share presses, the values are jackknife pseudo-values: presses, or whole cells, can be resampled with them. Those of
    a cell of two presses are equal.
    """
    values = np.full(len(pairs), np.nan)
    for cell in np.unique(cells):
        at = np.flatnonzero((cells == cell) & np.isfinite(pairs))
        if not len(at):
            continue
        mean = pairs[at].mean()
        share = 2.0 * (len(at) - 1) / (len(at) - 2) if len(at) > 2 else 0.0
        values[at] = 100.0 - (100.0 - mean - share * (pairs[at] - mean)) / np.sqrt(2.0)
    return values


def average(values: Floats, cells: NDArray[np.int64]) -> Average | None:
    """The average of `ceiling_values`, or of how much more they are than a model's scores; None without a value.

    The interval resamples whole cells: the error of a model is common to the presses of a cell. For fewer than three
    cells it holds for these cells only, and resamples their presses.
    """
    known = np.isfinite(values)
    values, cells = values[known], cells[known]
    found = summarise(values, cells)
    if found is None:
        return None
    return Average(found.avg, interval_over_groups(values, cells) or found.avg_interval, found.n)


def is_near(below: float, interval: Interval | None, points: float = NEAR_POINTS) -> bool | None:
    """Whether a model is at most `points` below the ceiling; None where the interval of the difference holds both."""
    low, high = interval if interval is not None else (below, below)
    return None if low <= points < high else high <= points
