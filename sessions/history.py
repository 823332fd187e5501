"""How the strokes of a session came about, from its journal: takes that did not count, and where the paper was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sessions.errors import SessionDamaged, in_one_line
from sessions.journal.codec import Line
from sessions.journal.events import NONSENSE
from sessions.journal.journal import JOURNAL_NAME, replay

CAPTURE, DIP, ZERO_TOUCH = "capture", "dip", "zero_touch"


@dataclass(frozen=True, slots=True)
class Found:
    """One zero touch."""

    method: str
    touch_z_mm: float
    """Height of the paper at the sheet's origin, base frame."""


@dataclass(frozen=True, slots=True)
class History:
    """Of one session that was collected here."""

    photographed: int
    """Marks that were photographed and judged."""
    pressed_again: tuple[str, ...]
    """Stroke of each take that did not count and was made again on another cell."""
    left_out: tuple[str, ...]
    """Strokes that were given up, or skipped by the operator."""
    found: tuple[Found, ...]
    """Every zero touch, in order of time."""

    @property
    def moved_mm(self) -> float:
        """Highest less lowest paper that strokes may have been pressed on."""
        heights = [one.touch_z_mm for one in self.found]
        return max(heights) - min(heights) if heights else 0.0


def history_of(folder: Path) -> History | None:
    """None where there is no journal: an import, or a file that was sent alone. Raises `SessionDamaged`."""
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
        tuple(_found(line) for line in done if line["kind"] == ZERO_TOUCH),
    )


def _found(line: Line) -> Found:
    result = line["result"]
    return Found(str(result.get("method", "")), float(result["touch_z_mm"]))
