"""Counts of a session's strokes and the state of its patches, as screens show them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from brushloop.collect.engine.snapshot import Mark, SheetMap
from brushloop.collect.rig.paper import Layout
from brushloop.sessions.events import (
    CaptureResult,
    Condition,
    DipResult,
    Press,
    PressResult,
    ReviewResult,
    SelfCheckResult,
)
from brushloop.sessions.journal import RunState


@dataclass(slots=True)
class Tally:
    """Strokes counted by condition, and the marks on patches by (sheet, patch)."""

    marks: dict[tuple[int, int], Mark] = field(default_factory=dict[tuple[int, int], Mark])
    done: Counter[Condition] = field(default_factory=Counter[Condition])
    """Captures that count."""
    bad: Counter[Condition] = field(default_factory=Counter[Condition])
    """Captures that do not count."""
    left_out: Counter[Condition] = field(default_factory=Counter[Condition])
    """Strokes that were given up."""
    over: set[str] = field(default_factory=set[str])
    """Names of finished strokes, kept or given up."""

    def sheet(self, number: int, layout: Layout) -> SheetMap:
        """Return the map of sheet `number`, counted from 0."""
        marks = tuple(self.marks.get((number, patch)) for patch in range(layout.capacity))
        return SheetMap(number + 1, layout.columns, layout.rows, marks)


def tally_of(state: RunState) -> Tally:
    """Count what the journal holds; of the strokes that were pressed again after a review, only the repetition."""
    tally = Tally(dict.fromkeys(state.used_patches, Mark.VOID))
    for begin in state.running.values():
        if begin.patch is not None:
            tally.marks[begin.sheet, begin.patch] = Mark.NOW
    kept: dict[str, Press] = {}
    for step in state.files.values():
        match step.result:
            case PressResult(press=press):
                _mark(tally, press, Mark.WAITING)
            case SelfCheckResult(sheet=sheet, patches=patches):
                tally.marks |= {(sheet, patch): Mark.CHECK for patch in patches}
            case CaptureResult(press=press, kept=True):
                _mark(tally, press, Mark.KEPT)
                kept[press.stroke_id] = press
                tally.done[press.condition] += 1
                tally.over.add(press.stroke_id)
            case CaptureResult(press=press, retake=retake):
                _mark(tally, press, Mark.BAD)
                tally.bad[press.condition] += 1
                if not retake:
                    _leave_out(tally, press)
            case DipResult(skipped=Press() as press):
                _leave_out(tally, press)
            case ReviewResult(again=again):
                for stroke in again:
                    press = kept[stroke.stroke_id]
                    _mark(tally, press, Mark.BAD)
                    tally.bad[press.condition] += 1
                    tally.done[press.condition] -= 1
            case _:
                pass
    return tally


def _mark(tally: Tally, press: Press, mark: Mark) -> None:
    if press.sheet is not None and press.patch is not None:
        tally.marks[press.sheet, press.patch] = mark


def _leave_out(tally: Tally, press: Press) -> None:
    tally.left_out[press.condition] += 1
    tally.over.add(press.stroke_id)
