"""Progress of a run, kept for snapshots: counts, times, and the newest lines of the log."""

from __future__ import annotations

import contextlib
import threading
from collections import Counter, deque
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

from brushloop.collect.engine.control import State
from brushloop.collect.engine.last_capture import LastCapture
from brushloop.collect.engine.snapshot import CellCount, Snapshot, in_set_up
from brushloop.collect.engine.tally import Tally, tally_of
from brushloop.collect.operator import Prompt
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.protocols.plan import AGAIN, Planned, with_review
from brushloop.collect.protocols.steps import MARKING, Step
from brushloop.collect.rig.paper import Layout, Sheet
from brushloop.drivers.clock import Clock
from brushloop.sessions.events import ReviewResult, StepKind, StepResult
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
        self._plan = protocol.planned(layout)
        self._by_index = {p.index: p for p in self._plan}
        self._first_free_index = 1 + max(self._by_index, default=0)
        self._tally = Tally()
        self._state = RunState()
        self._sheet: Sheet | None = None
        self._done_at_start = 0
        self._started_ns = clock.now_ns()
        self._first_stroke_ns: int | None = None
        self._last_stroke_ns: int | None = None
        self._over_ns: int | None = None
        self._session_id = "" if resumes is None else resumes.name
        self._source = ""
        self._folder = "" if resumes is None else str(resumes)
        self._step = ""
        self._index: int | None = None
        self._ink_level: float | None = None
        self._error = ""
        self._logged = 0
        self._messages: deque[str] = deque(maxlen=LOG_LINES)
        self._last: LastCapture | None = None
        self.found: dict[StepKind, StepResult] = {}
        """Results of the set-up steps of this process."""
        self.set_up: StepKind | None = None
        """Set-up step in progress."""
        self.set_up_over = False
        """Whether this process has begun a step after the set-up."""

    def opened(self, store: SessionStore, sheet: Sheet) -> None:
        """Begin with what a new or resumed session holds. `sheet` is how the paper is divided into patches."""
        with self._lock:
            self._folder = str(store.folder)
            self._sheet = sheet
            self._state = store.state
            self._session_id = store.header.session_id
            self._source = store.header.source
            self._tally = tally_of(store.state)
            for review in store.state.results(ReviewResult):
                self._reviewed(review)
            self._done_at_start = self._tally.done.total()
        verb = f"resumed with {self._done_at_start} strokes" if self._done_at_start else "session"
        self.log(f"{verb}: {store.folder}")

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
            self._tally = tally_of(self._state)
            self.set_up_over = self.set_up_over or not in_set_up(step)
            if in_set_up(step):
                self.set_up = step.kind
            elif step.kind in (StepKind.DIP, StepKind.CAPTURE) or step.kind in MARKING:
                self._index = step.index

    def finished(self, step: Step, result: StepResult) -> None:
        """Note that a step is done."""
        with self._lock:
            self._tally = tally_of(self._state)
            if isinstance(result, ReviewResult):
                self._reviewed(result)
            self.set_up = None
            if in_set_up(step):
                self.found[step.kind] = result
            elif step.kind is StepKind.CAPTURE:
                self._last_stroke_ns = self._clock.now_ns()
                self._first_stroke_ns = self._first_stroke_ns or self._last_stroke_ns

    def cut(self) -> None:
        """Note that a step was cut short."""
        with self._lock:
            self._tally = tally_of(self._state)
            self.set_up = None

    @property
    def first_free_index(self) -> int:
        """The lowest index above all steps of the protocol; the steps of repeated strokes begin there."""
        return self._first_free_index

    def more_than(self, stroke_id: str) -> bool:
        """Whether a stroke other than this one is still to be made."""
        with self._lock:
            return any(p.stroke_id != stroke_id and p.stroke_id not in self._tally.over for p in self._plan)

    def made_again(self, stroke_id: str) -> Planned:
        """Return the stroke that replaces `stroke_id`."""
        with self._lock:
            return next(p for p in self._plan if p.stroke_id == f"{stroke_id}{AGAIN}")

    def planned(self, step: Step) -> Planned:
        """The stroke that a step belongs to."""
        return self._by_index[step.index]

    def show(self, last: LastCapture) -> None:
        """Show the newest capture."""
        with self._lock:
            self._last = last

    def not_kept(self) -> None:
        """Show that the newest capture does not count."""
        with self._lock:
            self._last = None if self._last is None else replace(self._last, kept=False)

    def inked(self, level: float | None) -> None:
        """Show the level of the well before a dip, 0 to 1; None if nothing measures it."""
        with self._lock:
            self._ink_level = level

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

    def snapshot(
        self,
        state: State,
        tip_mm: tuple[float, float, float] | None,
        force_n: float | None = None,
        prompt: Prompt | None = None,
    ) -> Snapshot:
        """One consistent snapshot; values that only the engine knows keep their defaults."""
        with self._lock:
            tally = self._tally
            current = self._current()
            waiting = (p for p in self._plan if p.stroke_id not in tally.over and p is not current)
            following = next(waiting, None)
            counts = Counter(p.condition for p in self._plan)
            grid = tuple(
                CellCount(
                    asked,
                    tally.done[asked],
                    count,
                    tally.bad[asked],
                    tally.left_out[asked],
                    current is not None and asked == current.condition,
                    following is not None and asked == following.condition,
                )
                for asked, count in sorted(counts.items())
            )
            return Snapshot(
                session_id=self._session_id,
                source=self._source,
                state=state,
                step=self._step,
                strokes_done=tally.done.total(),
                strokes_planned=len(self._plan),
                grid=grid,
                voids=len(self._state.cut),
                given_up=tally.left_out.total(),
                elapsed_s=((self._over_ns or self._clock.now_ns()) - self._started_ns) / 1e9,
                eta_s=self._eta_s(),
                tip_mm=tip_mm,
                force_n=force_n,
                prompt=prompt,
                ink_level=self._ink_level,
                messages=tuple(self._messages),
                error=self._error,
                messages_before=self._logged - len(self._messages),
                sheet=None if self._sheet is None else tally.sheet(self._state.sheet, self._sheet.layout),
                last=self._last,
                stroke="" if current is None else current.stroke_id,
                folder=self._folder,
            )

    def _reviewed(self, result: ReviewResult) -> None:
        """Replace each stroke that was marked bad by its repeat."""
        self._plan = with_review(self._plan, result)
        self._by_index = {p.index: p for p in self._plan}

    def _current(self) -> Planned | None:
        """The stroke in progress."""
        if self._index is None or self._over_ns is not None:
            return None
        stroke = self._by_index.get(self._index)
        return None if stroke is None or stroke.stroke_id in self._tally.over else stroke

    def _eta_s(self) -> float | None:
        left = sum(p.stroke_id not in self._tally.over for p in self._plan)
        timed = self._tally.done.total() - self._done_at_start - 1
        if self._first_stroke_ns is None or self._last_stroke_ns is None or timed < 1:
            return 0.0 if left == 0 else None
        per_stroke_s = (self._last_stroke_ns - self._first_stroke_ns) / 1e9 / timed
        return left * per_stroke_s
