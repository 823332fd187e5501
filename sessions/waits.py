"""How long the brush waited with its ink before each stroke, and whose wait was unlike the others'."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from typing import TypeVar

from sessions.journal.lines import Line

LEAST_S = 2.0
"""A difference that no ink shows."""
SPREADS = 3.0
"""Median absolute deviations of the session's waits that are still alike."""
LEAST_STROKES = 4
"""With fewer there is no telling which of them is the odd one."""
WAIT = "dip_to_touch_s"
"""What a result, a stroke and a column of an export call it."""

_K = TypeVar("_K")


def waits_of(segments: Iterable[Line]) -> dict[int, float]:
    """Seconds from dip to touch by the still that shows the stroke, from a journal's finished steps in their order.

    Sessions from before waits were recorded hold none.
    """
    pressed: dict[str, float] = {}
    waits: dict[int, float] = {}
    for line in segments:
        result = line["result"]
        match line["kind"]:
            case "press" | "draw":
                pressed.pop(str(result.get("stroke_id")), None)
                if isinstance(wait := result.get(WAIT), int | float):
                    pressed[str(result["stroke_id"])] = float(wait)
            case "capture" if (wait := pressed.get(str(result.get("stroke_id")))) is not None:
                waits[int(result["still"])] = wait
            case _:
                pass
    return waits


def limit_s(waits: Iterable[float]) -> tuple[float, float] | None:
    """(median, how far from it is still alike) of a session's waits; None for too few."""
    told = list(waits)
    if len(told) < LEAST_STROKES:
        return None
    median = statistics.median(told)
    return median, max(LEAST_S, SPREADS * statistics.median(abs(wait - median) for wait in told))


def unlike(waits: Mapping[_K, float]) -> dict[_K, str]:
    """Why, in words, for each stroke whose wait is far from the others'."""
    if (found := limit_s(waits.values())) is None:
        return {}
    median, most_s = found
    return {
        key: f"touched the paper {wait:.1f} s after its dip, the others after {median:.1f} s"
        for key, wait in waits.items()
        if abs(wait - median) > most_s
    }
