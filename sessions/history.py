"""History of a session's strokes: takes that did not count, paper heights, waits from dip to touch, and remarks.

Remarks (bad, good again, a note) are added to captures afterwards. `remarks.jsonl` holds one line per remark, with a
CRC as in the journal; the latest remark on a still counts. The recording itself is never changed, so that a closed
session stays byte for byte as recorded.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from brushloop.sessions.events import CaptureResult, DipResult, Remark, ZeroTouchResult, line_of
from brushloop.sessions.journal import JOURNAL_NAME, Journal, replay, undamaged
from brushloop.sessions.run_state import RunState

REMARKS_NAME = "remarks.jsonl"
LEAST_S = 2.0
"""Smallest difference between waits that can be visible in the ink, s."""
SPREADS = 3.0
"""Median absolute deviations within which waits count as alike."""
LEAST_STROKES = 4
"""Number of strokes below which no wait can be called an outlier."""

_K = TypeVar("_K")


@dataclass(frozen=True, slots=True)
class History:
    """Takes and paper heights of one session, from its journal."""

    photographed: int
    """Marks that were photographed and judged."""
    pressed_again: tuple[str, ...]
    """Strokes of takes that did not count and were repeated on another patch."""
    left_out: tuple[str, ...]
    """Strokes that were given up, or skipped by the operator."""
    touches: tuple[ZeroTouchResult, ...]
    """Zero touches in order of time."""

    @property
    def moved_mm(self) -> float:
        """Difference between the highest and the lowest paper found, mm."""
        heights = [touch.touch_z_mm for touch in self.touches]
        return max(heights) - min(heights) if heights else 0.0


def history_of(folder: Path) -> History | None:
    """Read the journal; None for a recording without one. Raises `SessionDamaged`."""
    journal = folder / JOURNAL_NAME
    if not journal.is_file():
        return None
    state = replay(journal)
    captures = state.results(CaptureResult)
    rejected = [capture for capture in captures if not capture.kept]
    skipped = [dip.skipped for dip in state.results(DipResult) if dip.skipped is not None]
    left_out = [*(capture.press for capture in rejected if not capture.retake), *skipped]
    return History(
        len(captures),
        tuple(capture.press.stroke_id for capture in rejected if capture.retake),
        tuple(press.stroke_id for press in left_out),
        tuple(state.results(ZeroTouchResult)),
    )


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


def add_remark(folder: Path, remark: Remark) -> None:
    """Append a remark and wait until it is on disk. Raises `SessionError` where that fails."""
    journal = Journal(folder / REMARKS_NAME, remark.t_ns)
    try:
        journal.append(remark.t_ns, line_of(remark))
    finally:
        journal.close()


def mark_bad_or_good(folder: Path, still: int, stroke_id: str, t_ns: int) -> bool:
    """Switch a capture between bad and good, keep its note, and return whether it is bad now. Raises `SessionError`."""
    known = remarks_of(folder).get(still)
    bad, note = (True, "") if known is None else (not known.bad, known.note)
    add_remark(folder, Remark(t_ns=t_ns, still=still, stroke_id=stroke_id, bad=bad, note=note))
    return bad


def remarks_of(folder: Path) -> dict[int, Remark]:
    """Latest remark for each still; empty where there is none. Raises `SessionDamaged`."""
    path = folder / REMARKS_NAME
    remarks = [entry.event for entry in undamaged(path).entries] if path.is_file() else []
    return {remark.still: remark for remark in remarks if isinstance(remark, Remark)}
