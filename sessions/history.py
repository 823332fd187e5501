"""History of a session's strokes: takes that did not count, paper heights, waits from dip to touch."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from brushloop.sessions.errors import SessionDamaged, in_one_line
from brushloop.sessions.journal import JOURNAL_NAME, Line
from brushloop.sessions.journal.events import NONSENSE
from brushloop.sessions.journal.journal import replay

CAPTURE, DIP, ZERO_TOUCH = "capture", "dip", "zero_touch"
LEAST_S = 2.0
"""Smallest difference between waits that can be visible in the ink, s."""
SPREADS = 3.0
"""Median absolute deviations within which waits count as alike."""
LEAST_STROKES = 4
"""Number of strokes below which no wait can be called an outlier."""
WAIT = "dip_to_touch_s"
"""Name of the wait in a step's result, in a stroke and in an export's columns."""

_K = TypeVar("_K")


@dataclass(frozen=True, slots=True)
class ZeroTouch:
    """One zero touch."""

    method: str
    touch_z_mm: float
    """Height of the paper at the sheet's origin, base frame."""


@dataclass(frozen=True, slots=True)
class History:
    """Takes and paper heights of one session, from its journal."""

    photographed: int
    """Marks that were photographed and judged."""
    pressed_again: tuple[str, ...]
    """Strokes of takes that did not count and were repeated on another patch."""
    left_out: tuple[str, ...]
    """Strokes that were given up, or skipped by the operator."""
    found: tuple[ZeroTouch, ...]
    """Zero touches in order of time."""

    @property
    def moved_mm(self) -> float:
        """Difference between the highest and the lowest paper found, mm."""
        heights = [one.touch_z_mm for one in self.found]
        return max(heights) - min(heights) if heights else 0.0


def history_of(folder: Path) -> History | None:
    """Read the journal; None for a recording without one. Raises `SessionDamaged`."""
    journal = folder / JOURNAL_NAME
    if not journal.is_file():
        return None
    done = replay(journal).segments
    try:
        return _history(done)
    except NONSENSE as error:
        raise SessionDamaged(journal, f"a result makes no sense: {in_one_line(error)}") from None


def _history(done: list[Line]) -> History:
    captures = [line["result"] for line in done if line["kind"] == CAPTURE]
    dips = [line["result"] for line in done if line["kind"] == DIP]
    rejected = [result for result in captures if not result.get("kept", True)]
    given_up = [*(r for r in rejected if not r.get("retake")), *(r for r in dips if r.get("skipped"))]
    return History(
        len(captures),
        tuple(str(result["stroke_id"]) for result in rejected if result.get("retake")),
        tuple(str(result["stroke_id"]) for result in given_up),
        tuple(_zero_touch(line) for line in done if line["kind"] == ZERO_TOUCH),
    )


def _zero_touch(line: Line) -> ZeroTouch:
    result = line["result"]
    return ZeroTouch(str(result.get("method", "")), float(result["touch_z_mm"]))


def waits_of(segments: Iterable[Line]) -> dict[int, float]:
    """Seconds from dip to touch, by number of the still that shows the stroke, from a journal's finished steps.

    Empty for sessions recorded before waits were measured.
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
    """Median of a session's waits and the distance from it that counts as alike; None for too few waits."""
    known = list(waits)
    if len(known) < LEAST_STROKES:
        return None
    median = statistics.median(known)
    return median, max(LEAST_S, SPREADS * statistics.median(abs(wait - median) for wait in known))


def unlike(waits: Mapping[_K, float]) -> dict[_K, str]:
    """Reason for each stroke whose wait differs from the others'."""
    if (found := limit_s(waits.values())) is None:
        return {}
    median, most_s = found
    return {
        key: f"touched the paper {wait:.1f} s after its dip, the others after {median:.1f} s"
        for key, wait in waits.items()
        if abs(wait - median) > most_s
    }
