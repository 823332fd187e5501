"""What a run has done so far, kept for snapshots: counts, times, and the newest lines of the log."""

from __future__ import annotations

import threading
from collections import Counter, deque

from collect.asking import Prompt
from collect.protocols.plans import ProtocolConfig, planned
from collect.snapshot import CellCount, Snapshot
from collect.states import State
from collect.steps import Result, StepKind
from drivers.clock import Clock
from sessions.store import SessionStore

LOG_LINES = 200


class Progress:
    """Written by the engine's thread, read from any."""

    def __init__(self, protocol: ProtocolConfig, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._plan = planned(protocol)
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

    def opened(self, store: SessionStore) -> None:
        """A session was made or resumed: count what it already holds."""
        with self._lock:
            self._session_id = store.header.session_id
            self._source = store.header.source
            self._voids = store.state.voids
            for line in store.state.done.values():
                if line["kind"] == StepKind.CAPTURE:
                    self._take(line["result"])
            self._at_start = self._done.total()
        verb = f"resumed with {self._at_start} strokes" if self._at_start else "session"
        self.log(f"{verb}: {store.folder}")

    def doing(self, what: str) -> None:
        """A step, in words."""
        with self._lock:
            self._step = what

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
            grid = tuple(
                CellCount(h, a, self._done[(h, a)], planned) for (h, a), planned in sorted(self._planned.items())
            )
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
