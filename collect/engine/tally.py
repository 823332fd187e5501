"""Counts of a session's strokes and the state of its paper cells, computed from the results of its steps."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from brushloop.collect.engine.snapshot import Mark, SheetMap
from brushloop.collect.protocols.steps import MARKING, Result, Step, StepKind

if TYPE_CHECKING:
    from brushloop.sessions.journal.journal import Replay

Place = tuple[int, int]
"""Sheet and paper cell, both from 0."""
GridCell = tuple[float, float]
"""H in mm, alpha in deg."""


class Tally:
    """Counts of strokes and marks of paper cells. Not thread-safe: `Progress` holds its lock around every call."""

    def __init__(self) -> None:
        self._marks: dict[Place, Mark] = {}
        self._stroke_at: dict[str, Place] = {}
        self._cell_of: dict[str, GridCell] = {}
        self._shape = (0, 0)
        self.done: Counter[GridCell] = Counter()
        """Captures that count."""
        self.bad: Counter[GridCell] = Counter()
        """Captures that do not count."""
        self.left_out: Counter[GridCell] = Counter()
        """Strokes that were given up."""
        self.over: set[str] = set()
        """Names of finished strokes, kept or given up."""

    def opened(self, state: Replay, columns: int, rows: int) -> None:
        """Begin with the used cells of a session, on sheets of that shape; then pass its results to `finished`."""
        self._shape = (columns, rows)
        self._marks = dict.fromkeys(state.used_patches, Mark.VOID)

    def begun(self, step: Step, place: Place | None) -> None:
        """Note that a step begins; `place` is where it marks the paper."""
        if place is not None and step.kind in MARKING:
            self._marks[place] = Mark.NOW

    def voided(self, place: Place | None) -> None:
        """Note that a step was cut short; its cell stays used."""
        if place is not None and self._marks.get(place) is Mark.NOW:
            self._marks[place] = Mark.VOID

    def finished(self, kind: str, result: Result) -> None:
        """Note that a step is done."""
        match kind:
            case StepKind.PRESS | StepKind.DRAW:
                place = (int(result["sheet"]), int(result["patch"]))
                self._marks[place] = Mark.WAITING
                self._stroke_at[str(result["stroke_id"])] = place
            case StepKind.SELF_CHECK if "patch" in result:
                for cell in result.get("patches", [result["patch"]]):
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
        """Return the map of sheet `number`, counted from 0."""
        columns, rows = self._shape
        marks = tuple(self._marks.get((number, cell)) for cell in range(columns * rows))
        return SheetMap(number + 1, columns, rows, marks)

    def _captured(self, result: Result) -> None:
        stroke_id, cell = str(result["stroke_id"]), _cell(result)
        kept = bool(result.get("kept", True))
        self._cell_of[stroke_id] = cell
        place = self._stroke_at.get(stroke_id)
        if place is not None:
            self._marks[place] = Mark.KEPT if kept else Mark.BAD
        if kept:
            self.done[cell] += 1
            self.over.add(stroke_id)
        else:
            self.bad[cell] += 1
            if not result.get("retake"):
                self._leave_out(result)

    def _reviewed(self, result: Result) -> None:
        """Stop counting captures that were marked bad. Their strokes stay finished; others replace them."""
        for name, _index in result["again"]:
            stroke_id = str(name)
            self._marks[self._stroke_at[stroke_id]] = Mark.BAD
            cell = self._cell_of[stroke_id]
            self.bad[cell] += 1
            self.done[cell] -= 1

    def _leave_out(self, result: Result) -> None:
        self.left_out[_cell(result)] += 1
        self.over.add(str(result["stroke_id"]))


def _cell(result: Result) -> GridCell:
    return float(result["depth_mm"]), float(result["tilt_deg"])
