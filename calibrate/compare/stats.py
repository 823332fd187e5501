"""Summaries with intervals, and paired tests. All from a fixed seed: equal scores give equal numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SEED = 0
MOST_DRAWS, LEAST_DRAWS, WORK = 2000, 200, 4_000_000
"""Draws of a bootstrap: as many as `WORK` strokes allow, between the two."""
LEAST_CELLS, LEAST_PRESSES, MANY_PRESSES = 3, 3, 5
FLIPS = 10_000
EXACT = 13
"""With so many differences or fewer every flip of signs is tried."""
PIECE = 1_000_000


@dataclass(frozen=True, slots=True)
class Summary:
    """Of some scores; intervals are 95 %, None for fewer than two."""

    n: int
    max: float
    min: float
    avg: float
    median: float
    avg_interval: tuple[float, float] | None
    median_interval: tuple[float, float] | None


def summarise(values: Floats, strata: NDArray[np.int64]) -> Summary | None:
    """Of (n,) scores, NaN left out; None where none is left.

    Strokes are drawn again with replacement within their stratum (a cell of a session), so that the share of each cell
    stays what it is. With fewer than five presses in a typical cell that would be too sure of itself: then whole cells
    are drawn. No interval for one cell with fewer than three presses.
    """
    known = np.isfinite(values)
    values, strata = values[known], strata[known]
    if not len(values):
        return None
    intervals: tuple[tuple[float, float] | None, tuple[float, float] | None] = (None, None)
    _, counts = np.unique(strata, return_counts=True)
    by_cell = len(counts) >= LEAST_CELLS and float(np.median(counts)) < MANY_PRESSES
    if by_cell or len(values) >= LEAST_PRESSES * len(counts):
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


def _draws(values: Floats, strata: NDArray[np.int64]) -> Iterator[tuple[Floats, Floats]]:
    """Means and medians of redrawn samples, some at a time: memory stays flat."""
    order = np.argsort(strata, kind="stable")
    ordered = values[order]
    _, first, inverse, counts = np.unique(strata[order], return_index=True, return_inverse=True, return_counts=True)
    start, size = first[inverse], counts[inverse]
    rng = np.random.default_rng(SEED)
    for some in _pieces(len(values)):
        drawn = ordered[start + (rng.random((some, len(values))) * size).astype(np.int64)]
        yield drawn.mean(axis=1), np.median(drawn, axis=1)


def _cell_draws(values: Floats, strata: NDArray[np.int64]) -> Iterator[tuple[Floats, Floats]]:
    """The same with whole strata redrawn: each value then counts as often as its stratum was drawn."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    _, inverse = np.unique(strata[order], return_inverse=True)
    many = int(inverse.max()) + 1
    rng = np.random.default_rng(SEED)
    for some in _pieces(len(values)):
        times = rng.multinomial(many, np.full(many, 1.0 / many), some)[:, inverse]
        total = times.cumsum(axis=1)
        half = 0.5 * total[:, -1:]
        middle = 0.5 * (ordered[(total >= half).argmax(axis=1)] + ordered[(total > half).argmax(axis=1)])
        yield (times @ ordered) / total[:, -1], middle


def _pieces(size: int) -> Iterator[int]:
    left = min(MOST_DRAWS, max(LEAST_DRAWS, WORK // size))
    while left:
        some = min(left, max(1, PIECE // size))
        yield some
        left -= some


@dataclass(frozen=True, slots=True)
class Paired:
    """What became better: the mean of paired differences, its 95 % interval, and how easily chance makes it."""

    n: int
    mean: float
    interval: tuple[float, float] | None
    p: float
    """Two-sided, by flipping the signs of differences: exact up to 13 of them, else by 10,000 random flips."""


def paired(before: Floats, after: Floats) -> Paired | None:
    """`after` minus `before`, pair by pair, NaN left out; None where no pair is left."""
    difference = after - before
    difference = difference[np.isfinite(difference)]
    n = len(difference)
    if not n:
        return None
    mean = float(difference.mean())
    interval = None
    if n > 1:
        interval = _interval(np.concatenate([means for means, _ in _draws(difference, np.zeros(n, np.int64))]))
    # Below a millionth of a point nothing is a difference: reports keep six digits.
    if np.all(np.abs(difference) < 1e-6):
        return Paired(n, mean, interval, 1.0)
    reach = abs(mean) - 1e-12
    if n <= EXACT:
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=n)))
        return Paired(n, mean, interval, float((np.abs(signs @ difference / n) >= reach).mean()))
    rng = np.random.default_rng(SEED)
    beyond, left = 0, FLIPS
    while left:
        some = min(left, max(1, PIECE // n))
        signs = rng.choice(np.array([-1.0, 1.0]), (some, n))
        beyond += int((np.abs(signs @ difference / n) >= reach).sum())
        left -= some
    return Paired(n, mean, interval, (beyond + 1) / (FLIPS + 1))


def holm(p_values: list[float]) -> list[float]:
    """Holm's correction: p-values that hold for all the tests together."""
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    out = [0.0] * len(p_values)
    highest = 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        out[k] = highest
    return out


def _interval(draws: Floats) -> tuple[float, float]:
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)
