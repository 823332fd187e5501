"""Which cell of which sheet holds what, folded from the journal and kept up as steps end."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from collect.protocols.steps import MARKING, Result, Step, StepKind

if TYPE_CHECKING:
    from sessions.journal.journal import Replay

Place = tuple[int, int]
"""Sheet and cell, both from 0."""


class Mark(StrEnum):
    """What became of a paper cell that was ever pressed."""

    NOW = "now"
    WAITING = "pressed"
    """Not photographed yet."""
    KEPT = "kept"
    BAD = "bad"
    """Photographed, and not counted."""
    VOID = "void"
    """The press was cut."""
    CHECK = "self-check"


@dataclass(frozen=True, slots=True)
class SheetMap:
    """The sheet that is in, cell by cell, row by row from the far edge."""

    number: int
    """From 1."""
    columns: int
    rows: int
    marks: tuple[Mark | None, ...]
    """None is blank."""


class Tally:
    """Written by the engine's thread, read from any."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._marks: dict[Place, Mark] = {}
        self._stroke_at: dict[str, Place] = {}
        self._cell_of: dict[str, tuple[float, float]] = {}
        self._shape = (0, 0)
        self.bad: dict[tuple[float, float], int] = {}
        """Captures by (H, alpha) that were made and did not count."""
        self.over: set[str] = set()
        """Strokes that are finished: kept, or left out."""
        self.left_out: dict[tuple[float, float], int] = {}

    def opened(self, state: Replay, columns: int, rows: int) -> None:
        """Count what a session already holds, on sheets of that shape."""
        with self._lock:
            self._shape = (columns, rows)
            self._marks = dict.fromkeys(state.used_cells, Mark.VOID)
        for line in state.segments:
            self.finished(str(line["kind"]), line["result"])

    def begun(self, step: Step, place: Place | None) -> None:
        """A step begins; where it marks the paper, on that place."""
        if place is not None and step.kind in MARKING:
            with self._lock:
                self._marks[place] = Mark.NOW

    def voided(self, place: Place | None) -> None:
        """A step was cut; what it was pressing is burnt."""
        with self._lock:
            if place is not None and self._marks.get(place) is Mark.NOW:
                self._marks[place] = Mark.VOID

    def finished(self, kind: str, result: Result) -> None:
        """A step is done."""
        with self._lock:
            match kind:
                case StepKind.PRESS | StepKind.DRAW:
                    place = (int(result["sheet"]), int(result["cell"]))
                    self._marks[place] = Mark.WAITING
                    self._stroke_at[str(result["stroke_id"])] = place
                case StepKind.SELF_CHECK if "cell" in result:
                    for cell in result.get("cells", [result["cell"]]):
                        self._marks[(int(result["sheet"]), int(cell))] = Mark.CHECK
                case StepKind.CAPTURE:
                    self._captured(result)
                case StepKind.REVIEW:
                    self._reviewed(result)
                case _:
                    pass
            if result.get("skipped"):
                self._leave_out(result)

    def sheet(self, number: int) -> SheetMap:
        """The sheet of that number, from 0."""
        with self._lock:
            columns, rows = self._shape
            marks = tuple(self._marks.get((number, cell)) for cell in range(columns * rows))
        return SheetMap(number + 1, columns, rows, marks)

    def _captured(self, result: Result) -> None:
        kept = bool(result.get("kept", True))
        self._cell_of[str(result["stroke_id"])] = (float(result["height_mm"]), float(result["tilt_deg"]))
        place = self._stroke_at.get(str(result["stroke_id"]))
        if place is not None:
            self._marks[place] = Mark.KEPT if kept else Mark.BAD
        if not kept:
            cell = (float(result["height_mm"]), float(result["tilt_deg"]))
            self.bad[cell] = self.bad.get(cell, 0) + 1
        if kept:
            self.over.add(str(result["stroke_id"]))
        elif not result.get("retake"):
            self._leave_out(result)

    def _reviewed(self, result: Result) -> None:
        """What was marked bad stays over: another stroke is made in its place."""
        for name, _index in result["again"]:
            stroke_id = str(name)
            self._marks[self._stroke_at[stroke_id]] = Mark.BAD
            cell = self._cell_of[stroke_id]
            self.bad[cell] = self.bad.get(cell, 0) + 1

    def _leave_out(self, result: Result) -> None:
        cell = (float(result["height_mm"]), float(result["tilt_deg"]))
        self.left_out[cell] = self.left_out.get(cell, 0) + 1
        self.over.add(str(result["stroke_id"]))
