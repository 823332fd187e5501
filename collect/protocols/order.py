"""The order of strokes: rounds, shuffled or as written, with the conditions of a design spread over the sheet.

Cells of a sheet are used in order, so a stroke's number says where it will lie. The sheet is cut into three bands of
rows and three of columns. Within each round, pairs of strokes change places wherever that evens out how often each
(H, alpha) has come to lie in each band. Rounds stay whole, so a drift of ink still meets every condition alike. A void
press moves what follows by one cell: the balance is of the plan.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Hashable, Sequence
from dataclasses import replace

from collect.protocols.strokes import Planned
from collect.rig.paper import Layout


def numbered(rounds: list[list[Planned]], seed: int | None, layout: Layout | None) -> list[Planned]:
    """Put the rounds one after the other and number the strokes; with a seed and a layout, balance over the sheet."""
    index = 0
    for strokes in rounds:
        for k, stroke in enumerate(strokes):
            strokes[k] = replace(stroke, index=index)
            index += 1
    if seed is not None and layout is not None and layout.capacity > 0:
        conditions = [[(s.height_mm, s.tilt_deg) for s in strokes] for strokes in rounds]
        orders = balanced(conditions, layout, seed)
        rounds = [[strokes[i] for i in order] for strokes, order in zip(rounds, orders, strict=True)]
    return [stroke for strokes in rounds for stroke in strokes]


def shuffled(rounds: list[list[Planned]], seed: int | None) -> list[list[Planned]]:
    """Shuffle each round; without a seed, leave it as it is."""
    if seed is not None:
        rng = random.Random(seed)
        for strokes in rounds:
            rng.shuffle(strokes)
    return rounds


BANDS = 3
TRIALS_PER_STROKE = 60
"""Pairs tried for each stroke of a round; more hardly changes the result."""


def balanced(rounds: Sequence[Sequence[Hashable]], layout: Layout, seed: int) -> list[list[int]]:
    """The order of each round, as indices into it.

    `rounds` holds the condition of every stroke. The same arguments give the same order in every process.
    """
    rng = random.Random(f"balance {seed}")
    share = _shares(layout)
    seen: dict[Hashable, list[int]] = {}
    orders: list[list[int]] = []
    places = (place for place in itertools.count() if place not in layout.taken)
    for conditions in rounds:
        order = list(range(len(conditions)))
        bands = [_bands(layout, next(places)) for _ in order]
        for condition, at in zip(conditions, bands, strict=True):
            _count(seen.setdefault(condition, [0] * (2 * BANDS)), at, 1)
        for _ in range(TRIALS_PER_STROKE * len(order) if len(order) > 1 else 0):
            i, k = rng.sample(range(len(order)), 2)
            a, b = conditions[order[i]], conditions[order[k]]
            if a == b or bands[i] == bands[k]:
                continue
            before = _unevenness(seen[a], share) + _unevenness(seen[b], share)
            _exchange(seen[a], seen[b], bands[i], bands[k])
            if _unevenness(seen[a], share) + _unevenness(seen[b], share) < before - 1e-9:
                order[i], order[k] = order[k], order[i]
            else:
                _exchange(seen[a], seen[b], bands[k], bands[i])
        orders.append(order)
    return orders


def _bands(layout: Layout, place: int) -> tuple[int, int]:
    """(row band, column band) of the stroke with that number; column bands are numbered after the row bands."""
    row, column = divmod(place % layout.capacity, layout.columns)
    return BANDS * row // layout.rows, BANDS + BANDS * column // layout.columns


def _shares(layout: Layout) -> list[float]:
    """Share of the sheet that each band holds; bands that hold nothing count as one cell."""
    counts = [0] * (2 * BANDS)
    for place in range(layout.capacity):
        _count(counts, _bands(layout, place), 1)
    return [max(count, 1) / layout.capacity for count in counts]


def _count(counts: list[int], bands: tuple[int, int], by: int) -> None:
    for band in bands:
        counts[band] += by


def _exchange(a: list[int], b: list[int], from_bands: tuple[int, int], to_bands: tuple[int, int]) -> None:
    for counts, out, into in ((a, from_bands, to_bands), (b, to_bands, from_bands)):
        _count(counts, out, -1)
        _count(counts, into, 1)


def _unevenness(counts: list[int], share: list[float]) -> float:
    """Smallest where the counts are in proportion to the shares."""
    return sum(count * count / part for count, part in zip(counts, share, strict=True))
