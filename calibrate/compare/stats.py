"""Summaries with intervals, and paired tests. The seed is fixed: equal scores give equal numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.line import student_95

Floats = NDArray[np.float64]
Interval = tuple[float, float]
"""Ends of a 95 % interval."""
SEED = 0
MAX_DRAWS, MIN_DRAWS, MAX_VALUES_DRAWN = 2000, 200, 4_000_000
"""Limits on the draws of a bootstrap: the most and the fewest, and the most values in all draws together."""
MIN_CELLS, MIN_PRESSES, MANY_PRESSES = 3, 3, 5
FLIPS = 10_000
"""Number of random sign flips; where no more than that exist (up to 13 pairs), each is tried once."""
BATCH_VALUES = 200_000
"""Values held in memory at a time, which changes no result; a small array also stays in the cache."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of scores; intervals are None where there are too few scores."""

    n: int
    max: float
    min: float
    avg: float
    median: float
    avg_interval: Interval | None = None
    median_interval: Interval | None = None

    @property
    def range_and_avg(self) -> tuple[float, float, float]:
        """Max, min and average, in the order of the paper's tables."""
        return self.max, self.min, self.avg


def summarise(values: Floats, strata: NDArray[np.int64] | None = None) -> Summary | None:
    """Summarise (n,) scores without NaN; None if none is left. Intervals need strata, (n,) numbers.

    Strokes are resampled with replacement within their stratum (a cell of a session), so that the share of each cell
    is preserved. With fewer than five presses in a typical cell such an interval would be too narrow, so whole cells
    are resampled. A single cell with fewer than three presses gets no interval.
    """
    known = np.isfinite(values)
    values = values[known]
    if not len(values):
        return None
    intervals: tuple[Interval | None, Interval | None] = (None, None)
    if strata is not None:
        strata = strata[known]
        _, counts = np.unique(strata, return_counts=True)
        by_cell = len(counts) >= MIN_CELLS and float(np.median(counts)) < MANY_PRESSES
        if by_cell or len(values) >= MIN_PRESSES * len(counts):
            draws = _cell_draws(values, strata) if by_cell else _draws(values, strata)
            means, medians = (np.concatenate(part) for part in zip(*draws, strict=True))
            intervals = _interval(means), _interval(medians)
    return Summary(
        len(values),
        float(values.max()),
        float(values.min()),
        float(values.mean()),
        float(np.median(values)),
        *intervals,
    )


def interval_over_groups(values: Floats, groups: NDArray[np.int64]) -> Interval | None:
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


def _draws(values: Floats, strata: NDArray[np.int64]) -> Iterator[tuple[Floats, Floats]]:
    """Yield means and medians of bootstrap samples in batches, which bounds memory."""
    order = np.argsort(strata, kind="stable")
    ordered = values[order]
    _, first, inverse, counts = np.unique(strata[order], return_index=True, return_inverse=True, return_counts=True)
    start, size = first[inverse], counts[inverse]
    rng = np.random.default_rng(SEED)
    for some in _batches(len(values)):
        drawn = ordered[start + (rng.random((some, len(values))) * size).astype(np.int64)]
        yield drawn.mean(axis=1), np.median(drawn, axis=1)


def _cell_draws(values: Floats, strata: NDArray[np.int64]) -> Iterator[tuple[Floats, Floats]]:
    """The same, resampling whole strata: each value counts as often as its stratum was drawn."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    _, inverse = np.unique(strata[order], return_inverse=True)
    many = int(inverse.max()) + 1
    rng = np.random.default_rng(SEED)
    for some in _batches(len(values)):
        times = rng.multinomial(many, np.full(many, 1.0 / many), some)[:, inverse]
        total = times.cumsum(axis=1)
        half = 0.5 * total[:, -1:]
        middle = 0.5 * (ordered[(total >= half).argmax(axis=1)] + ordered[(total > half).argmax(axis=1)])
        yield (times @ ordered) / total[:, -1], middle


def _batches(size: int) -> Iterator[int]:
    left = min(MAX_DRAWS, max(MIN_DRAWS, MAX_VALUES_DRAWN // size))
    while left:
        some = min(left, max(1, BATCH_VALUES // size))
        yield some
        left -= some


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


def paired(before: Floats, after: Floats, groups: NDArray[np.int64]) -> Paired | None:
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
    import scipy.stats  # slow to import

    untyped: Any = scipy.stats
    n = len(difference)

    def distance(sample: Floats, axis: int) -> Floats:
        return np.abs(sample.mean(axis=axis))

    options: dict[str, Any] = {"alternative": "greater", "vectorized": True, "batch": max(1, BATCH_VALUES // n)}
    if 2**n <= FLIPS:
        found = untyped.permutation_test((difference,), distance, permutation_type="samples", **options)
    else:
        # `permutation_test` would draw whole permutations: twenty times slower for a large session.
        rng = np.random.default_rng(SEED)

        def flipped(size: tuple[int, int]) -> Floats:
            return rng.choice(np.array([-1.0, 1.0]), size) * difference

        found = untyped.monte_carlo_test(difference, flipped, distance, n_resamples=FLIPS, **options)
    return float(found.pvalue)


def holm(p_values: list[float]) -> list[float]:
    """Holm's correction: p-values that hold for all the tests together."""
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    out = [0.0] * len(p_values)
    highest = 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        out[k] = highest
    return out


def _interval(draws: Floats) -> Interval:
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)
