"""What a screen shows of a run: one immutable `Snapshot`; and `Progress`, which keeps it up to date.

What was pressed, kept or left out is counted from the journal's `RunState`; only the log and the step in progress are
remembered here.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING, Any

from brushloop.collect.engine.control import State
from brushloop.collect.protocols.steps import Planned, with_review
from brushloop.sessions.events import CaptureResult, DipResult, Press, PressResult, ReviewResult, SelfCheckResult
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from brushloop.collect.operator import OperatorRequest, Prompt
    from brushloop.collect.photograph.checks import Verdict
    from brushloop.collect.protocols.config import ProtocolConfig
    from brushloop.collect.rig.paper import Sheet
    from brushloop.drivers.devices import ForceSample
    from brushloop.drivers.host import Clock
    from brushloop.sessions.journal import RunState
    from brushloop.sessions.store import SessionStore

SLOT_NS = 100_000_000
"""Time that one value of the trace of forces covers: the peak, so that a short one is seen."""
TRACE_SLOTS = 50
REFRESH_S = 0.1
"""Time between two snapshots that a screen or a progress bar shows."""


@dataclass(frozen=True, slots=True)
class ConditionCount:
    """Strokes of one condition."""

    condition: Condition
    done: int
    planned: int
    bad: int = 0
    """Captures that did not count."""
    left_out: int = 0
    """Strokes that were given up."""
    now: bool = False
    """The stroke that is being made or photographed has this condition."""
    next: bool = False
    """The next planned stroke has this condition."""


class Mark(StrEnum):
    """State of a paper patch that is not blank."""

    NOW = "now"
    WAITING = "pressed"
    """Not photographed yet."""
    KEPT = "kept"
    BAD = "bad"
    """Photographed, but does not count."""
    VOID = "void"
    """The press was cut short."""
    CHECK = "self-check"


@dataclass(frozen=True, slots=True)
class SheetMap:
    """The current sheet, patch by patch, row by row from the far edge."""

    number: int
    """From 1."""
    columns: int
    marks: tuple[Mark | None, ...]
    """None for a blank patch."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A reduced picture of the camera's newest frame."""

    image: NDArray[np.uint8]
    """(h, w) gray."""
    blur_px: float | None = None
    """Standard deviation of the blur at the steepest edges, in pixels of the full frame; None without an edge."""


@dataclass(frozen=True, slots=True)
class LastCapture:
    """One capture, as a screen shows it."""

    press: Press
    still: int
    kept: bool
    verdict: Verdict | None
    """None where captures are not judged."""
    photo: NDArray[np.uint8] | None = None
    """(h, w) gray: the field around the zero-touch point, seen from above."""
    binary: NDArray[np.bool_] | None = None
    """(128, 128), true where there is ink: the image that a validation compares, in the millimetre alignment."""
    model: NDArray[np.bool_] | None = None
    """(128, 128) mark of CCD-BSM as published for the same H and alpha; None for a figure, or if it gives none."""

    @property
    def likeness(self) -> float | None:
        """CSIM of `binary` and `model`, 0 to 1; None if either is missing or shows no ink."""
        if self.binary is None or self.model is None or not (self.binary.any() and self.model.any()):
            return None
        from brushloop.model.similarity import csim  # only where a capture is shown

        return csim(self.binary.astype(float), self.model.astype(float))


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a run at one moment."""

    session_id: str = ""
    source: str = ""
    state: State = State.IDLE
    step: str = ""
    """What is being done, in words."""
    strokes_done: int = 0
    strokes_planned: int = 0
    grid: tuple[ConditionCount, ...] = ()
    voids: int = 0
    """Attempts that were cut short."""
    elapsed_s: float = 0.0
    eta_s: float | None = None
    """Remaining time in seconds; None until two strokes of this process give a time per stroke."""
    messages: tuple[str, ...] = ()
    """The lines of the log."""
    error: str = ""
    """Why the run failed or stopped; empty otherwise."""
    tip_mm: tuple[float, float, float] | None = None
    """Position of the brush tip; None while the arm sends no fresh pose."""
    given_up: int = 0
    """Strokes that were left out, because every take was bad or the operator asked for it."""
    force_n: float | None = None
    """Force less the sensor's bias; None without a sensor or a fresh sample."""
    force_ceiling_n: float | None = None
    """Force above which the arm is stopped while the brush is down; None without a sensor, and until it is zeroed."""
    ink_level: float | None = None
    """Level of the well before the last dip, 0 to 1; None if nothing measures it."""
    prompt: Prompt | None = None
    """Question that waits for an answer."""
    target_mm: tuple[float, float, float] | None = None
    """Where the arm was last sent."""
    parked: bool = False
    """Whether the tip was last seen at the park position."""
    rest_unknown: bool = False
    """The run is over, and it is not known that the arm is at rest."""
    trace_n: tuple[float, ...] = ()
    """Peak force of each tenth of a second, oldest first."""
    picture: Picture | None = None
    """Picture of the camera; None without a preview."""
    sheet: SheetMap | None = None
    last: LastCapture | None = None
    """Newest capture of this process."""
    requests: tuple[OperatorRequest, ...] = ()
    """Key requests that are still pending."""
    folder: str = ""
    """Folder of the session; empty until there is one."""
    no_pose_s: float | None = None
    """Time since the arm last sent a pose; None below a second. While it is set, no value on the screen is live."""


def eta_text(now: Snapshot) -> str:
    """`ETA 12:05`, or nothing while no stroke has been timed."""
    return "" if now.eta_s is None else f"ETA {minutes_text(now.eta_s)}"


def minutes_text(seconds: float) -> str:
    """Minutes and seconds as `12:05`."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def no_pose_text(now: Snapshot) -> str:
    """`no pose for 1.4 s`, or nothing while the arm sends its pose."""
    if now.no_pose_s is None:
        return ""
    return f"no pose for {now.no_pose_s:.{1 if now.no_pose_s < 10.0 else 0}f} s"


class Progress:
    """Progress of one run; written by the engine's thread, read from any."""

    def __init__(self, protocol: ProtocolConfig, clock: Clock, sheet: Sheet, resumes: Path | None) -> None:
        """`resumes` is the folder of the session that is resumed."""
        self._clock = clock
        self._lock = threading.Lock()
        self._planned = protocol.planned()
        self.plan = self._planned
        """Every stroke, those that were marked bad in a review replaced by their repetition."""
        self.left = self._planned
        """Those that neither count nor are left out."""
        self._sheet = sheet
        self._started_ns = clock.now_ns()
        self._over_ns: int | None = None
        self._messages: list[str] = []
        self.tip_mm: tuple[float, float, float] | None = None
        """Where the brush tip was last seen, however long ago."""
        self.picture: Picture | None = None
        """The camera's newest picture."""
        self._peaks_n: deque[float] = deque(maxlen=TRACE_SLOTS)
        self._slot = -1
        self._now = Snapshot(
            session_id="" if resumes is None else resumes.name,
            folder="" if resumes is None else str(resumes),
            strokes_planned=len(self.plan),
            grid=self._grid([], [], [], at_work=False),
        )

    def opened(self, store: SessionStore) -> int:
        """Begin with what a new or resumed session holds; returns how many strokes of it count."""
        self._change(session_id=store.folder.name, folder=str(store.folder), source=store.header.source)
        self.count(store.state)
        return self._now.strokes_done

    def doing(self, what: str) -> None:
        """Say what the run is doing, in words."""
        self._change(step=what)

    @contextlib.contextmanager
    def meanwhile(self, what: str) -> Generator[None]:
        """Within the block, say what else the run is doing in the middle of a step."""
        before = self._now.step
        self.doing(what)
        yield
        self.doing(before)

    def planned(self, index: int) -> Planned:
        """The stroke whose steps have this index."""
        return next(stroke for stroke in self.plan if stroke.index == index)

    def show(self, last: LastCapture) -> None:
        """Show the newest capture."""
        self._change(last=last)

    def not_kept(self) -> None:
        """Show that the newest capture does not count."""
        if self._now.last is not None:
            self._change(last=replace(self._now.last, kept=False))

    def log(self, text: str, *, warning: bool = False) -> None:
        """Add a line to the operator's log."""
        with self._lock:
            self._messages.append(f"warning: {text}" if warning else text)

    def force(self, sample: ForceSample) -> None:
        """Take a sample of the force sensor; called at its full rate."""
        slot, force_n = sample.stamp.host_ns // SLOT_NS, math.hypot(*sample.force_n)
        with self._lock:
            if slot > self._slot:
                self._slot = slot
                self._peaks_n.append(force_n)
            elif self._peaks_n:
                self._peaks_n[-1] = max(self._peaks_n[-1], force_n)

    def zeroed(self, ceiling_n: float) -> None:
        """Note that the force sensor is zeroed, and the force above which the arm is stopped."""
        self._change(force_ceiling_n=ceiling_n)

    def over(self, error: str = "") -> None:
        """Note that the run is over, and why if it ended early."""
        self._over_ns = self._clock.now_ns()
        self._change(error=error)

    def snapshot(self, **values: Any) -> Snapshot:
        """One consistent snapshot, with the `values` that only the engine knows."""
        with self._lock:
            return replace(
                self._now,
                elapsed_s=((self._over_ns or self._clock.now_ns()) - self._started_ns) / 1e9,
                messages=tuple(self._messages),
                trace_n=tuple(self._peaks_n),
                picture=self.picture,
                **values,
            )

    def _change(self, **values: Any) -> None:
        with self._lock:
            self._now = replace(self._now, **values)

    def count(self, state: RunState) -> None:
        """Count what the journal holds; of strokes that were pressed again after a review, only the repetition."""
        plan = self._planned
        marks: dict[tuple[int | None, int | None], Mark] = dict.fromkeys(state.used_patches, Mark.VOID)
        at_work = False
        for begin in state.running.values():
            marks |= {(begin.sheet, patch): Mark.NOW for patch in begin.patches[:1]}
            at_work = begin.press is not None
        made: dict[tuple[str, int], tuple[Press, Mark]] = {}
        left_out: list[Press] = []
        times_ns: list[int] = []
        ink_level: float | None = None
        for step in state.files.values():
            match step.result:
                case PressResult(press=press):
                    made[press.stroke_id, press.take] = press, Mark.WAITING
                case SelfCheckResult(sheet=sheet, patches=patches):
                    marks |= {(sheet, patch): Mark.CHECK for patch in patches}
                case CaptureResult(press=press, kept=counts, retake=retake):
                    made[press.stroke_id, press.take] = press, Mark.KEPT if counts else Mark.BAD
                    times_ns += [step.t_ns] if counts and step.t_ns >= self._started_ns else []
                    left_out += [] if counts or retake else [press]
                case DipResult(skipped=skipped):
                    ink_level = step.result.ink_level
                    left_out += [] if skipped is None else [skipped]
                case ReviewResult() as review:
                    plan = with_review(plan, review)
                    again = {stroke.stroke_id for stroke in review.again}
                    made |= {key: (press, Mark.BAD) for key, (press, _) in made.items() if press.stroke_id in again}
                case _:
                    pass
        marks |= {(press.sheet, press.patch): mark for press, mark in made.values()}
        kept, bad = ([press for press, mark in made.values() if mark is wanted] for wanted in (Mark.KEPT, Mark.BAD))
        ended = {press.stroke_id for press in (*kept, *left_out)}
        self.plan, self.left = plan, [stroke for stroke in plan if stroke.stroke_id not in ended]
        on_sheet = tuple(marks.get((state.sheet, patch)) for patch in range(self._sheet.capacity))
        self._change(
            strokes_done=len(kept),
            strokes_planned=len(plan),
            grid=self._grid(kept, bad, left_out, at_work=at_work),
            voids=sum(begin.press is not None for begin, _ in state.cut),
            given_up=len(left_out),
            eta_s=self._eta_s(times_ns),
            ink_level=ink_level,
            sheet=SheetMap(state.sheet + 1, self._sheet.columns, on_sheet),
        )

    def _grid(
        self, kept: Iterable[Press], bad: Iterable[Press], left_out: Iterable[Press], *, at_work: bool
    ) -> tuple[ConditionCount, ...]:
        """The strokes of each condition. `at_work`: the first of those left is being made or photographed."""
        counts = [Counter(press.condition for press in presses) for presses in (kept, bad, left_out)]
        strokes = iter(self.left)
        current = next(strokes, None) if at_work else None
        following = next(strokes, None)
        return tuple(
            ConditionCount(
                asked,
                counts[0][asked],
                planned,
                counts[1][asked],
                counts[2][asked],
                current is not None and asked == current.condition,
                following is not None and asked == following.condition,
            )
            for asked, planned in sorted(Counter(stroke.condition for stroke in self.plan).items())
        )

    def _eta_s(self, times_ns: Sequence[int]) -> float | None:
        """Remaining time, from the median time between this process's captures that count: a pause is no pace."""
        if not self.left:
            return 0.0
        each_ns = [after - before for before, after in pairwise(times_ns)]
        return len(self.left) * median(each_ns) / 1e9 if each_ns else None
