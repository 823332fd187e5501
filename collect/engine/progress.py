"""Progress of a run, kept for snapshots: what the journal says of the plan, and the newest lines of the log."""

from __future__ import annotations

import contextlib
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from brushloop.collect.engine.control import State
from brushloop.collect.engine.last_capture import LastCapture
from brushloop.collect.engine.snapshot import CellCount, Mark, SheetMap, Snapshot
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.plan import Planned, with_review
from brushloop.collect.protocols.steps import CaptureStep, DipStep, DrawStep, PressStep, Step
from brushloop.collect.rig.paper import Layout
from brushloop.drivers.host import Clock
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
from brushloop.sessions.store import SessionStore

LOG_LINES = 200


class Progress:
    """Progress of one run; written by the engine's thread, read from any."""

    def __init__(
        self, protocol: ProtocolConfig, clock: Clock, layout: Layout | None = None, resumes: Path | None = None
    ) -> None:
        """`layout` is that of the sheet; it determines the order of the strokes. `resumes` is the session's folder."""
        self._clock = clock
        self._lock = threading.Lock()
        self._planned = protocol.planned(layout)
        self._layout = layout
        self._resumes = resumes
        self._store: SessionStore | None = None
        self._tally = _Tally(self._planned)
        self._started_ns = clock.now_ns()
        self._over_ns: int | None = None
        self._step = ""
        self._index: int | None = None
        self._error = ""
        self._logged = 0
        self._messages: deque[str] = deque(maxlen=LOG_LINES)
        self._last: LastCapture | None = None

    def opened(self, store: SessionStore) -> int:
        """Begin with what a new or resumed session holds; returns how many strokes of it count."""
        with self._lock:
            self._store = store
            self._count()
            return self._tally.done.total()

    def doing(self, what: str) -> None:
        """Say what the run is doing, in words."""
        with self._lock:
            self._step = what

    @contextlib.contextmanager
    def meanwhile(self, what: str) -> Generator[None]:
        """Within the block, say what else the run is doing in the middle of a step."""
        before = self._step
        self.doing(what)
        yield
        self.doing(before)

    def begun(self, step: Step) -> None:
        """Note that a step begins."""
        with self._lock:
            self._count()
            if isinstance(step, DipStep | PressStep | DrawStep | CaptureStep):
                self._index = step.index

    def finished(self) -> None:
        """Note that a step is done, or was cut short."""
        with self._lock:
            self._count()

    @property
    def first_free_index(self) -> int:
        """The lowest index above all steps of the protocol; the steps of repeated strokes begin there."""
        return 1 + max((stroke.index for stroke in self._planned), default=0)

    def more_than(self, stroke_id: str) -> bool:
        """Whether a stroke other than this one is still to be made."""
        with self._lock:
            return any(stroke.stroke_id != stroke_id for stroke in self._tally.left)

    def planned(self, index: int) -> Planned:
        """The stroke whose steps have this index."""
        return next(stroke for stroke in self._tally.plan if stroke.index == index)

    def show(self, last: LastCapture) -> None:
        """Show the newest capture."""
        with self._lock:
            self._last = last

    def not_kept(self) -> None:
        """Show that the newest capture does not count."""
        with self._lock:
            self._last = None if self._last is None else replace(self._last, kept=False)

    def log(self, text: str, *, warning: bool = False) -> None:
        """Add a line to the operator's log."""
        with self._lock:
            self._logged += 1
            self._messages.append(f"warning: {text}" if warning else text)

    def ended(self, why: str) -> None:
        """Note that the run ended early, and why."""
        with self._lock:
            self._error = why
            self._over_ns = self._clock.now_ns()

    def closed(self, text: str) -> None:
        """Note that the run is done."""
        with self._lock:
            self._over_ns = self._clock.now_ns()
        self.log(text)

    def snapshot(self, state: State) -> Snapshot:
        """One consistent snapshot; values that only the engine knows keep their defaults."""
        with self._lock:
            tally, store = self._tally, self._store
            current = next((p for p in tally.left if p.index == self._index), None) if self._over_ns is None else None
            following = next((p for p in tally.left if p is not current), None)
            folder = self._resumes if store is None else store.folder
            return Snapshot(
                session_id="" if folder is None else folder.name,
                source="" if store is None else store.header.source,
                state=state,
                step=self._step,
                strokes_done=tally.done.total(),
                strokes_planned=len(tally.plan),
                grid=tally.grid(current, following),
                voids=tally.voids,
                given_up=tally.left_out.total(),
                elapsed_s=((self._over_ns or self._clock.now_ns()) - self._started_ns) / 1e9,
                eta_s=tally.eta_s(),
                ink_level=tally.ink_level,
                messages=tuple(self._messages),
                error=self._error,
                messages_before=self._logged - len(self._messages),
                sheet=None if store is None or self._layout is None else tally.sheet(self._layout),
                last=self._last,
                folder="" if folder is None else str(folder),
            )

    def _count(self) -> None:
        """Count again what the journal holds: its state is changed by the engine's thread only."""
        assert self._store is not None
        self._tally = _tally_of(self._store.state, self._planned, self._started_ns)


@dataclass(slots=True)
class _Tally:
    """What the journal says of the plan at one moment."""

    plan: list[Planned]
    """After the reviews."""
    sheet_number: int = 0
    voids: int = 0
    marks: dict[tuple[int, int], Mark] = field(default_factory=dict[tuple[int, int], Mark])
    """State of patches, by (sheet, patch)."""
    done: Counter[Condition] = field(default_factory=Counter[Condition])
    """Captures that count."""
    bad: Counter[Condition] = field(default_factory=Counter[Condition])
    """Captures that do not count."""
    left_out: Counter[Condition] = field(default_factory=Counter[Condition])
    """Strokes that were given up."""
    over: set[str] = field(default_factory=set[str])
    """Names of finished strokes, kept or given up."""
    captured_ns: list[int] = field(default_factory=list[int])
    """Times of this process's captures that count."""
    ink_level: float | None = None

    @property
    def left(self) -> Iterable[Planned]:
        """Strokes that are still to be made, in order."""
        return (stroke for stroke in self.plan if stroke.stroke_id not in self.over)

    def grid(self, current: Planned | None, following: Planned | None) -> tuple[CellCount, ...]:
        """The strokes of each condition."""
        return tuple(
            CellCount(
                asked,
                self.done[asked],
                count,
                self.bad[asked],
                self.left_out[asked],
                current is not None and asked == current.condition,
                following is not None and asked == following.condition,
            )
            for asked, count in sorted(Counter(stroke.condition for stroke in self.plan).items())
        )

    def sheet(self, layout: Layout) -> SheetMap:
        """The map of the sheet that is in."""
        marks = tuple(self.marks.get((self.sheet_number, patch)) for patch in range(layout.capacity))
        return SheetMap(self.sheet_number + 1, layout.columns, layout.rows, marks)

    def eta_s(self) -> float | None:
        """Remaining time; None until two strokes of this process give a time per stroke."""
        left, timed = sum(1 for _ in self.left), len(self.captured_ns) - 1
        if not left:
            return 0.0
        return left * (self.captured_ns[-1] - self.captured_ns[0]) / 1e9 / timed if timed > 0 else None

    def mark(self, press: Press, mark: Mark) -> None:
        """Note the state of the press's patch."""
        if press.sheet is not None and press.patch is not None:
            self.marks[press.sheet, press.patch] = mark

    def leave_out(self, press: Press) -> None:
        """Count a stroke that was given up."""
        self.left_out[press.condition] += 1
        self.over.add(press.stroke_id)


def _tally_of(state: RunState, planned: list[Planned], since_ns: int) -> _Tally:
    """Count what the journal holds; of the strokes that were pressed again after a review, only the repetition."""
    tally = _Tally(planned, state.sheet, len(state.cut), dict.fromkeys(state.used_patches, Mark.VOID))
    for begin in state.running.values():
        for patch in begin.patches[:1]:
            tally.marks[begin.sheet, patch] = Mark.NOW
    kept: dict[str, Press] = {}
    for step in state.files.values():
        match step.result:
            case PressResult(press=press):
                tally.mark(press, Mark.WAITING)
            case SelfCheckResult(sheet=sheet, patches=patches):
                tally.marks |= {(sheet, patch): Mark.CHECK for patch in patches}
            case CaptureResult(press=press, kept=True):
                tally.mark(press, Mark.KEPT)
                kept[press.stroke_id] = press
                tally.done[press.condition] += 1
                tally.over.add(press.stroke_id)
                tally.captured_ns += [step.t_ns] if step.t_ns >= since_ns else []
            case CaptureResult(press=press, retake=retake):
                tally.mark(press, Mark.BAD)
                tally.bad[press.condition] += 1
                if not retake:
                    tally.leave_out(press)
            case DipResult(ink_level=level, skipped=skipped):
                tally.ink_level = level
                if skipped is not None:
                    tally.leave_out(skipped)
            case ReviewResult(again=again) as review:
                tally.plan = with_review(tally.plan, review)
                for stroke in again:
                    press = kept[stroke.stroke_id]
                    tally.mark(press, Mark.BAD)
                    tally.bad[press.condition] += 1
                    tally.done[press.condition] -= 1
            case _:
                pass
    return tally
