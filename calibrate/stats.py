"""Statistics: summaries with intervals, paired tests, the ceiling, and odd waits.

The ceiling is the score of a perfect model, that is of the best image of each condition on a fresh press of it.
Two presses differ by the strays of both, a press and the best image only by those of one. Strays displace the edges of
a mark, and what a score loses grows with the distance between two edges. If the strays are independent from press to
press and about normal, their mean distance is sqrt 2 times that of one press from the best image. So the ceiling is 100
- (100 - pairs) / sqrt 2, where `pairs` is the mean score of two presses of a condition in percent: a U-statistic, which
two presses of each condition suffice for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from brushloop.sessions.events import CaptureResult
from brushloop.sessions.journal import RunState

K = TypeVar("K")
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Interval = tuple[float, float]
"""Ends of a 95 % interval."""
NORMAL_95 = 1.96
"""Half width of a 95 % interval in standard deviations that are known."""
SEED = 0
MIN_GROUPS = 3
"""Fewest groups whose differences tell an interval."""
FLIPS = 10_000
"""Number of random sign flips; where no more than that exist (up to 13 pairs), each is tried once."""
CEILING = "ceiling"
NEAR_POINTS = 1.5
"""Distance from the ceiling that counts as near, in points of average CSIM."""
ODD_S, ODD_SPREADS, LEAST_WAITS = 2.0, 3.0, 4
"""A wait is odd if it is this many seconds and median absolute deviations from the others."""
MAX_OTHERS = 9
"""Most others that a press or a writing is compared with: all those of ten, as in the paper, or the next nine of
more."""


def student_95(freedom: int) -> float:
    """Half width of a 95 % interval in standard errors that were estimated with so many degrees of freedom."""
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, 0.975))


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
    below_ceiling: float | None = None
    """Points below the ceiling; None where no condition was pressed twice."""
    below_interval: Interval | None = None
    below_n: int = 0
    below_avg: float | None = None
    """Number and average of the scores that have a ceiling: those of conditions that were pressed twice."""

    @property
    def range_and_avg(self) -> tuple[float | None, float | None, float]:
        """Max, min and average, in the order of the paper's tables."""
        return self.max, self.min, self.avg


def summarise(values: Floats, groups: Integers | None = None) -> Summary | None:
    """Summarise (n,) scores without NaN; None if none is left. An interval needs `groups`, (n,) numbers of conditions.

    The interval is that of whole conditions drawn anew, since the error of a model is common to the presses of a
    condition. For fewer than three conditions it holds for these conditions only: then single presses are drawn.
    """
    known = np.isfinite(values)
    values = values[known]
    if not len(values):
        return None
    interval = None
    if groups is not None:
        interval = interval_over_groups(values, groups[known]) or interval_over_groups(values, np.arange(len(values)))
    avg, high, low, median = (_round(value) for value in (values.mean(), values.max(), values.min(), np.median(values)))
    return Summary(len(values), avg, interval, high, low, median)


def interval_over_groups(values: Floats, groups: Integers) -> Interval | None:
    """Interval of the mean of (n,) values if whole groups were drawn anew; None for fewer than three groups.

    It is Student's, because a bootstrap of a few groups is too narrow.
    """
    _, group = np.unique(groups, return_inverse=True)
    mean, many = float(values.mean()), int(group.max()) + 1
    if many < MIN_GROUPS:
        return None
    off = np.bincount(group, values - mean)
    half = float(student_95(many - 1) * np.sqrt(many / (many - 1) * (off**2).sum()) / len(values))
    return _round(mean - half), _round(mean + half)


def _round(value: float) -> float:
    """Round to six decimals; further digits would differ between machines."""
    return round(float(value), 6)


def others_of(press: int, count: int) -> list[int]:
    """Numbers of the presses of a condition, or writings of a character, that one of `count` is compared with."""
    return [(press + step) % count for step in range(1, min(MAX_OTHERS, count - 1) + 1)]


def pair_means(count: int, scores: Callable[[int, list[int]], Floats]) -> Floats:
    """(count, measures) mean scores of each press of one condition with the others; NaN for a single press.

    `scores` gives the (others, measures) scores of a press with others, all by their numbers.
    """
    if count < 2:
        return np.full((count, scores(0, [0]).shape[1]), np.nan)
    return np.array([scores(k, others_of(k, count)).mean(axis=0) for k in range(count)])


def ceiling_values(pairs: Floats, groups: Integers) -> Floats:
    """(n,) percent, one for each press, whose mean is the ceiling; NaN for a press without another of its condition.

    `pairs` holds the mean score of each press with the others of its condition, `groups` the number of that condition.
    As pairs share presses, the values are jackknife pseudo-values: presses, or whole conditions, can be resampled with
    them. Those of a condition of two presses are equal.
    """
    values = np.full(len(pairs), np.nan)
    for group in np.unique(groups):
        at = np.flatnonzero((groups == group) & np.isfinite(pairs))
        if not len(at):
            continue
        mean = pairs[at].mean()
        share = 2.0 * (len(at) - 1) / (len(at) - 2) if len(at) > 2 else 0.0
        values[at] = 100.0 - (100.0 - mean - share * (pairs[at] - mean)) / np.sqrt(2.0)
    return values


def is_near(below: float, interval: Interval | None, points: float = NEAR_POINTS) -> bool | None:
    """Whether a model is at most `points` below the ceiling, in tenths as printed; None where both are possible."""
    low, high = (round(end, 1) for end in interval or (below, below))
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


def paired(before: Floats, after: Floats, groups: Integers) -> Paired:
    """`after` minus `before`, pair by pair, of at least one pair without NaN.

    Pairs of one group, (n,) numbers from 0, share an error, such as that of a model in one condition: they are flipped
    and drawn together.
    """
    difference = after - before
    sums, p = np.bincount(groups, difference), 1.0
    # Differences below one millionth are ignored: reports keep six digits.
    if len(sums) > 1 and np.abs(difference).max() >= 1e-6:
        from scipy.stats import permutation_test  # slow to import

        flips = permutation_test((sums,), np.sum, permutation_type="samples", n_resamples=FLIPS, rng=SEED)
        p = float(flips.pvalue)
    interval = interval_over_groups(difference, groups)
    return Paired(len(difference), len(sums), float(difference.mean()), interval, p)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction: p-values that hold for all the tests together."""
    p = np.array(p_values)
    order, left = np.argsort(p), len(p) - np.arange(len(p))
    p[order] = np.maximum.accumulate(np.minimum(1.0, left * p[order]))
    return p.tolist()


def waits_of(state: RunState) -> dict[int, float]:
    """Seconds from dip to touch, by number of the still that shows the stroke; of those that were measured."""
    presses = {capture.still: capture.press for capture in state.results(CaptureResult)}
    return {still: press.dip_to_touch_s for still, press in presses.items() if press.dip_to_touch_s is not None}


def odd_waits(waits: Mapping[K, float]) -> dict[K, str]:
    """Reason for each stroke whose ink waited longer, or less long, than that of the others: it may be drier or wetter.

    `waits` are seconds from dip to touch; fewer than four do not tell which of them is odd.
    """
    known = np.array([*waits.values()])
    if len(known) < LEAST_WAITS:
        return {}
    median = float(np.median(known))
    most_s = max(ODD_S, ODD_SPREADS * float(np.median(np.abs(known - median))))
    return {
        key: f"touched the paper {wait:.1f} s after its dip, other strokes after {median:.1f} s"
        for key, wait in waits.items()
        if abs(wait - median) > most_s
    }
