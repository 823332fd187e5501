"""Statistics: lines, summaries with intervals, paired tests, and the ceiling. Equal scores give equal numbers.

The ceiling is the score of a perfect model, that is of the best image of each cell on a fresh press of it. Presses of a
cell stray from each other. Two of them differ by the strays of both, a press and the best image only by those of one.
Strays displace the edges of a mark, and what a score loses grows with the distance between two edges. If the strays are
independent from press to press and about normal, their mean distance is sqrt 2 times that of one press from the best
image. So the ceiling is 100 - (100 - pairs) / sqrt 2, where `pairs` is the mean score of two presses of a cell in
percent: a U-statistic, which two presses of each cell suffice for. No template takes its place: one of a few presses
has strays of its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Interval = tuple[float, float]
"""Ends of a 95 % interval."""
SEED = 0
MAX_DRAWS, MIN_DRAWS, MAX_VALUES_DRAWN = 2000, 200, 4_000_000
"""Limits on the draws of a bootstrap: the most and the fewest, and the most values in all draws together."""
MIN_CELLS, MIN_PRESSES, MANY_PRESSES = 3, 3, 5
FLIPS = 10_000
"""Number of random sign flips; where no more than that exist (up to 13 pairs), each is tried once."""
CEILING = "ceiling"
NEAR_POINTS = 1.5
"""Distance from the ceiling that counts as near, in points of average CSIM."""
MAX_OTHERS = 9
"""Most others that a press or a writing is compared with: all those of ten, as in the paper, or the next nine of
more."""


def student_95(freedom: int) -> float:
    """Half width of a 95 % interval in standard errors that were estimated with so many degrees of freedom."""
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, 0.975))


@dataclass(frozen=True, slots=True)
class Line:
    """A fitted line, with the standard error of its slope."""

    slope: float
    intercept: float
    slope_se: float
    r: float
    n: int

    @property
    def interval(self) -> Interval:
        """95 % interval of the slope (Student's t with n - 2 degrees of freedom)."""
        reach = student_95(self.n - 2) * self.slope_se
        return self.slope - reach, self.slope + reach


def fit_line(x: Sequence[float], y: Sequence[float], weights: Sequence[float] | None = None) -> Line | None:
    """y = slope x + intercept; None with fewer than 3 points or no spread in x or y.

    Points may have positive `weights`, inversely proportional to their variances.
    """
    n = len(x)
    if n < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    share = np.ones(n) if weights is None else np.asarray(weights, np.float64)
    x_mean, y_mean = float(np.average(x, weights=share)), float(np.average(y, weights=share))
    xs, ys = np.asarray(x) - x_mean, np.asarray(y) - y_mean
    sxx, sxy, syy = (float((share * a * b).sum()) for a, b in ((xs, xs), (xs, ys), (ys, ys)))
    slope = sxy / sxx
    residual = ys - slope * xs
    slope_se = float(np.sqrt((share * residual**2).sum() / max(n - 2, 1) / sxx))
    return Line(slope, y_mean - slope * x_mean, slope_se, sxy / float(np.sqrt(sxx * syy)), n)


@dataclass(frozen=True, slots=True)
class Summary:
    """Scores in percent; an interval is None where there are too few of them.

    The ceiling is an average of its own, not of scores: it has no extremes and no median.
    """

    n: int
    avg: float
    avg_interval: Interval | None = None
    max: float | None = None
    min: float | None = None
    median: float | None = None
    median_interval: Interval | None = None
    below_ceiling: float | None = None
    """Points below the ceiling; None where no cell was pressed twice."""
    below_interval: Interval | None = None

    @property
    def range_and_avg(self) -> tuple[float, float, float]:
        """Max, min and average, in the order of the paper's tables."""
        assert self.max is not None, "the ceiling has no extremes"
        assert self.min is not None, "the ceiling has no extremes"
        return self.max, self.min, self.avg


def summarise(values: Floats, strata: Integers | None = None) -> Summary | None:
    """Summarise (n,) scores without NaN; None if none is left. Intervals need strata, (n,) numbers.

    Strokes are resampled with replacement within their stratum (a cell of a session), so that the share of each cell
    is preserved. With fewer than five presses in a typical cell such an interval would be too narrow, so whole cells
    are resampled. A single cell with fewer than three presses gets no interval.
    """
    known = np.isfinite(values)
    values = values[known]
    if not len(values):
        return None
    avg_interval, median_interval = None, None
    if strata is not None:
        strata = strata[known]
        _, counts = np.unique(strata, return_counts=True)
        by_cell = len(counts) >= MIN_CELLS and float(np.median(counts)) < MANY_PRESSES
        if by_cell or len(values) >= MIN_PRESSES * len(counts):
            draws = _cell_draws(values, strata) if by_cell else _draws(values, strata)
            avg_interval, median_interval = map(_interval, draws)
    avg, high, low, median = (_round(value) for value in (values.mean(), values.max(), values.min(), np.median(values)))
    return Summary(len(values), avg, avg_interval, high, low, median, median_interval)


def interval_over_groups(values: Floats, groups: Integers) -> Interval | None:
    """Interval of the mean of (n,) values if whole groups were drawn anew; None for fewer than three groups.

    It is Student's, because a bootstrap of a few groups is too narrow.
    """
    _, group = np.unique(groups, return_inverse=True)
    mean, many = float(values.mean()), int(group.max()) + 1
    if many < MIN_CELLS:
        return None
    off = np.bincount(group, values - mean)
    half = float(student_95(many - 1) * np.sqrt(many / (many - 1) * (off**2).sum()) / len(values))
    return mean - half, mean + half


def _draws(values: Floats, strata: Integers) -> tuple[Floats, Floats]:
    """Means and medians of bootstrap samples."""
    order = np.argsort(strata, kind="stable")
    ordered = values[order]
    _, first, inverse, counts = np.unique(strata[order], return_index=True, return_inverse=True, return_counts=True)
    drawn = (np.random.default_rng(SEED).random((_draw_count(values), len(values))) * counts[inverse]).astype(np.int64)
    sampled = ordered[first[inverse] + drawn]
    return sampled.mean(axis=1), np.median(sampled, axis=1)


def _cell_draws(values: Floats, strata: Integers) -> tuple[Floats, Floats]:
    """The same, resampling whole strata: each value counts as often as its stratum was drawn."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    _, inverse = np.unique(strata[order], return_inverse=True)
    many = int(inverse.max()) + 1
    times = np.random.default_rng(SEED).multinomial(many, np.full(many, 1.0 / many), _draw_count(values))[:, inverse]
    total = times.cumsum(axis=1)
    half = 0.5 * total[:, -1:]
    middle = 0.5 * (ordered[(total >= half).argmax(axis=1)] + ordered[(total > half).argmax(axis=1)])
    return (times @ ordered) / total[:, -1], middle


def _draw_count(values: Floats) -> int:
    return min(MAX_DRAWS, max(MIN_DRAWS, MAX_VALUES_DRAWN // len(values)))


def _interval(draws: Floats) -> Interval:
    return _ends(np.quantile(draws, [0.025, 0.975]))


def _ends(interval: Sequence[float] | Floats) -> Interval:
    low, high = interval
    return _round(low), _round(high)


def _round(value: float) -> float:
    """Round to six decimals; further digits would differ between machines."""
    return round(float(value), 6)


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


def ceiling_values(pairs: Floats, cells: Integers) -> Floats:
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


def average(values: Floats, cells: Integers) -> Summary | None:
    """The average of `ceiling_values`, or of how much more they are than a model's scores; None without a value.

    The interval resamples whole cells: the error of a model is common to the presses of a cell. For fewer than three
    cells it holds for these cells only, and resamples their presses.
    """
    known = np.isfinite(values)
    values, cells = values[known], cells[known]
    summary = summarise(values, cells)
    if summary is None:
        return None
    interval = interval_over_groups(values, cells)
    return Summary(summary.n, summary.avg, summary.avg_interval if interval is None else _ends(interval))


def is_near(below: float, interval: Interval | None, points: float = NEAR_POINTS) -> bool | None:
    """Whether a model is at most `points` below the ceiling; None where the interval of the difference holds both."""
    low, high = interval if interval is not None else (below, below)
    return None if low <= points < high else high <= points


@dataclass(frozen=True, slots=True)
class Paired:
    """Mean of paired differences, its 95 % interval, and its p-value."""

    n: int
    groups: int
    mean: float
    interval: Interval | None
    """Over whole groups; None for fewer than three."""
    p: float
    """Two-sided, by flipping the signs of whole groups: exact up to 13 of them, else by 10,000 random flips."""


def paired(before: Floats, after: Floats, groups: Integers) -> Paired | None:
    """`after` minus `before`, pair by pair, NaN left out; None where no pair is left.

    Pairs of one group, (n,) numbers, share an error, such as that of a model in one cell: they are flipped and drawn
    together.
    """
    difference = after - before
    known = np.isfinite(difference)
    difference = difference[known]
    n = len(difference)
    if not n:
        return None
    _, group = np.unique(groups[known], return_inverse=True)
    # Differences below one millionth are ignored: reports keep six digits.
    equal = bool(np.all(np.abs(difference) < 1e-6))
    sums = np.asarray(np.bincount(group, difference), np.float64)
    p = 1.0 if equal or len(sums) == 1 else _sign_flip_p(sums)
    return Paired(n, len(sums), float(difference.mean()), interval_over_groups(difference, group), p)


def _sign_flip_p(difference: Floats) -> float:
    """Two-sided p-value: share of sign flips whose mean is at least as far from 0; needs two or more differences."""
    n = len(difference)
    every = 2**n <= FLIPS
    if every:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=n)))
    else:
        signs = np.random.default_rng(SEED).choice(np.array([-1.0, 1.0]), (FLIPS, n))
    far = np.count_nonzero(np.abs(signs @ difference) >= abs(difference.sum()) * (1.0 - 1e-12))
    # Among random flips the one that was observed counts as well.
    return far / len(signs) if every else (far + 1) / (len(signs) + 1)


def holm(p_values: list[float]) -> list[float]:
    """Holm's correction: p-values that hold for all the tests together."""
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    out = [0.0] * len(p_values)
    highest = 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        out[k] = highest
    return out
