"""Strokes whose ink waited longer, or less long, on the brush than that of the others: they may be drier or wetter."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from typing import TypeVar

from brushloop.sessions.events import CaptureResult
from brushloop.sessions.journal import RunState

_K = TypeVar("_K")
LEAST_S = 2.0
"""Smallest difference between waits that can be visible in the ink, s."""
SPREADS = 3.0
"""Median absolute deviations within which waits count as alike."""
LEAST_STROKES = 4
"""Number of strokes below which no wait can be called an outlier."""


def waits_of(state: RunState) -> dict[int, float]:
    """Seconds from dip to touch, by number of the still that shows the stroke; of those that were measured."""
    captures = state.results(CaptureResult)
    return {one.still: one.press.dip_to_touch_s for one in captures if one.press.dip_to_touch_s is not None}


def limit_s(waits: Iterable[float]) -> tuple[float, float] | None:
    """Median of a session's waits and the distance from it that counts as alike; None for too few waits."""
    known = list(waits)
    if len(known) < LEAST_STROKES:
        return None
    median = statistics.median(known)
    return median, max(LEAST_S, SPREADS * statistics.median(abs(wait - median) for wait in known))


def unlike(waits: Mapping[_K, float]) -> dict[_K, str]:
    """Reason for each stroke whose wait differs from the others'."""
    if (limit := limit_s(waits.values())) is None:
        return {}
    median, most_s = limit
    return {
        key: f"touched the paper {wait:.1f} s after its dip, the others after {median:.1f} s"
        for key, wait in waits.items()
        if abs(wait - median) > most_s
    }
