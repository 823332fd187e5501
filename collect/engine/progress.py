"""What a run has done so far, kept for snapshots: counts, times, and the newest lines of the log."""

from __future__ import annotations

import contextlib
import threading
from collections import Counter, deque
from collections.abc import Generator
from dataclasses import replace

from collect.engine.last_capture import LastCapture
from collect.engine.snapshot import CellCount, Snapshot
from collect.engine.states import State
from collect.engine.tally import Place, Tally
from collect.operator import Prompt
from collect.protocols.adaptive import with_choice
from collect.protocols.plans import ProtocolConfig, planned
from collect.protocols.steps import MARKING, Result, Step, StepKind
from collect.protocols.strokes import AGAIN, Planned, with_review
from collect.rig.paper import Layout, Sheet
from drivers.clock import Clock
from sessions.store import SessionStore

LOG_LINES = 200


class Progress:
    """Written by the engine's thread, read from any."""

    def __init__(self, protocol: ProtocolConfig, clock: Clock, layout: Layout | None = None) -> None:
        """`layout` is the sheet's: it balances the order in which strokes come."""
        self._clock = clock
        self._lock = threading.Lock()
        self._plan = planned(protocol, layout)
        self._by_index = {p.index: p for p in self._plan}
        self._free_index = 1 + max(self._by_index, default=0)
        self._planned = Counter((p.height_mm, p.tilt_deg) for p in self._plan)
        self._done: Counter[tuple[float, float]] = Counter()
        self._at_start = 0
        self._started_ns = clock.now_ns()
        self._first_stroke_ns: int | None = None
        self._last_stroke_ns: int | None = None
        self._session_id = ""
        self._source = ""
        self._step = ""
        self._voids = 0
        self._given_up = 0
        self._ink_level: float | None = None
        self._error = ""
        self._logged = 0
        self._over_ns: int | None = None
        self._messages: deque[str] = deque(maxlen=LOG_LINES)
        self._tally = Tally()
        self._in_hand: int | None = None
        self._sheet = 0
        self._folder = ""
        self._last: LastCapture | None = None
        self.found: dict[StepKind, Result] = {}
        """What the set-up steps of this process, or of the session before it, found."""
        self.set_up: StepKind | None = None
        """The set-up step that is being done."""

    def opened(self, store: SessionStore, sheet: Sheet | None = None) -> None:
        """A session was made or resumed: count what it already holds. `sheet` is how the paper is divided."""
        if sheet is not None:
            self._tally.opened(store.state, sheet.columns, sheet.rows)
        with self._lock:
            self._folder = str(store.folder)
            self._sheet = store.state.sheet
            self._session_id = store.header.session_id
            self._source = store.header.source
            self._voids = store.state.voids
            for line in store.state.done.values():
                if line["kind"] == StepKind.CAPTURE:
                    self._take(line["result"])
                elif line["kind"] == StepKind.DIP and line["result"].get("skipped"):
                    self._given_up += 1
                elif line["kind"] == StepKind.CHOOSE:
                    self._chosen(line["result"])
                elif line["kind"] == StepKind.REVIEW:
                    self._reviewed(line["result"])
                elif line["kind"] == StepKind.BOARD:
                    self.found[StepKind.BOARD] = line["result"]
            self._at_start = self._done.total()
        verb = f"resumed with {self._at_start} strokes" if self._at_start else "session"
        self.log(f"{verb}: {store.folder}")

    @property
    def strokes_begun(self) -> bool:
        """Whether this process has come to the strokes."""
        return self._in_hand is not None

    def doing(self, what: str) -> None:
        """A step, in words."""
        with self._lock:
            self._step = what

    @contextlib.contextmanager
    def meanwhile(self, what: str) -> Generator[None]:
        """Something else in the midst of a step, in words; within the block."""
        before = self._step
        self.doing(what)
        yield
        self.doing(before)

    def begun(self, step: Step, place: Place | None) -> None:
        """A step begins; `place` is the sheet and cell that it marks."""
        self._tally.begun(step, place)
        with self._lock:
            if step.kind in (StepKind.DIP, StepKind.CAPTURE) or step.kind in MARKING - {StepKind.SELF_CHECK}:
                self._in_hand = step.index
            elif step.kind in (StepKind.BOARD, StepKind.ZERO_TOUCH, StepKind.SELF_CHECK):
                self.set_up = step.kind

    def finished(self, step: Step, result: Result) -> None:
        """A step is done."""
        self._tally.finished(step.kind, result)
        with self._lock:
            if step.kind is StepKind.CHOOSE:
                self._chosen(result)
            elif step.kind is StepKind.REVIEW:
                self._reviewed(result)
            self.set_up = None
            if step.kind in (StepKind.BOARD, StepKind.ZERO_TOUCH, StepKind.SELF_CHECK):
                self.found[step.kind] = result
            if result.get("skipped"):
                self._given_up += 1

    def cut(self, place: Place | None) -> None:
        """A step was cut."""
        self._tally.voided(place)
        with self._lock:
            self.set_up = None
        self.voided()

    def _chosen(self, result: Result) -> None:
        """Take a choice of an adaptive protocol into the plan, which is the worst case until then."""
        self._planned_now(with_choice(self._plan, result))

    def _reviewed(self, result: Result) -> None:
        """What was marked bad does not count any more; it is made again."""
        names = {str(name) for name, _ in result["again"]}
        self._done -= Counter((p.height_mm, p.tilt_deg) for p in self._plan if p.stroke_id in names)
        self._planned_now(with_review(self._plan, result))

    def _planned_now(self, plan: list[Planned]) -> None:
        self._plan = plan
        self._by_index = {p.index: p for p in plan}
        self._planned = Counter((p.height_mm, p.tilt_deg) for p in plan)

    @property
    def first_free_index(self) -> int:
        """An index that no step of the protocol has: those of strokes that are made again begin there."""
        return self._free_index

    def made_again(self, stroke_id: str) -> Planned:
        """The stroke that is made again in the place of that one."""
        with self._lock:
            return next(p for p in self._plan if p.stroke_id == f"{stroke_id}{AGAIN}")

    def skipped(self, step: Step) -> Result:
        """What a dip tells whose stroke is left out."""
        stroke = self._by_index[step.index]
        named = {"stroke_id": stroke.stroke_id, "height_mm": stroke.height_mm, "tilt_deg": stroke.tilt_deg}
        return {"skipped": True, **named}

    def sheet_in(self, sheet: int) -> None:
        """A sheet was put in, counted from 0."""
        with self._lock:
            self._sheet = sheet

    def show(self, last: LastCapture) -> None:
        """The newest capture."""
        with self._lock:
            self._last = last

    def looked_at(self, *, kept: bool) -> None:
        """What was decided about the newest capture."""
        with self._lock:
            self._last = None if self._last is None else replace(self._last, kept=kept)

    def captured(self, result: Result) -> None:
        """A mark was photographed and judged."""
        with self._lock:
            now_ns = self._clock.now_ns()
            self._first_stroke_ns = self._first_stroke_ns or now_ns
            self._last_stroke_ns = now_ns
            self._take(result)

    def inked(self, level: float | None) -> None:
        """The well's level before a dip, 0 to 1; None where nothing can tell."""
        with self._lock:
            self._ink_level = level

    def voided(self) -> None:
        """An attempt was cut."""
        with self._lock:
            self._voids += 1

    def log(self, text: str, *, warning: bool = False) -> None:
        """A line for the operator."""
        with self._lock:
            self._logged += 1
            self._messages.append(f"warning: {text}" if warning else text)

    def ended(self, why: str) -> None:
        """The run is over without being done."""
        with self._lock:
            self._error = why
            self._over_ns = self._clock.now_ns()

    def closed(self, text: str) -> None:
        """The run is done."""
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
        """One consistent picture."""
        with self._lock:
            at_work = self._in_hand is not None and self._over_ns is None
            in_hand = self._by_index.get(self._in_hand) if at_work and self._in_hand is not None else None
            if in_hand is not None and in_hand.stroke_id in self._tally.over:
                in_hand = None
            coming = (p for p in self._plan if p.stroke_id not in self._tally.over and p is not in_hand)
            following = next(coming, None)
            grid = tuple(
                CellCount(
                    *cell,
                    self._done[cell],
                    planned,
                    self._tally.bad.get(cell, 0),
                    self._tally.left_out.get(cell, 0),
                    in_hand is not None and cell == (in_hand.height_mm, in_hand.tilt_deg),
                    following is not None and cell == (following.height_mm, following.tilt_deg),
                )
                for cell, planned in sorted(self._planned.items())
            )
            sheet = self._tally.sheet(self._sheet) if self._folder else None
            return Snapshot(
                session_id=self._session_id,
                source=self._source,
                state=state,
                step=self._step,
                strokes_done=self._done.total(),
                strokes_planned=len(self._plan),
                grid=grid,
                voids=self._voids,
                given_up=self._given_up,
                elapsed_s=((self._over_ns or self._clock.now_ns()) - self._started_ns) / 1e9,
                eta_s=self._eta_s(),
                tip_mm=tip_mm,
                force_n=force_n,
                prompt=prompt,
                ink_level=self._ink_level,
                messages=tuple(self._messages),
                error=self._error,
                messages_before=self._logged - len(self._messages),
                sheet=sheet,
                last=self._last,
                stroke="" if in_hand is None else in_hand.stroke_id,
                folder=self._folder,
            )

    def _take(self, result: Result) -> None:
        if result.get("kept", True):
            self._count(result)
        elif not result["retake"]:
            self._given_up += 1

    def _count(self, result: Result) -> None:
        self._done[(float(result["height_mm"]), float(result["tilt_deg"]))] += 1

    def _eta_s(self) -> float | None:
        left = len(self._plan) - self._done.total()
        timed = self._done.total() - self._at_start - 1
        if self._first_stroke_ns is None or self._last_stroke_ns is None or timed < 1:
            return 0.0 if left == 0 else None
        per_stroke_s = (self._last_stroke_ns - self._first_stroke_ns) / 1e9 / timed
        return left * per_stroke_s
