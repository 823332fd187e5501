"""The state of a run after the events of its journal so far. Resume, screens, review, lists and repair read it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TypeVar

from brushloop.sessions import events
from brushloop.sessions.events import (
    Begin,
    CaptureResult,
    Closed,
    Done,
    DrawResult,
    Event,
    Lost,
    Open,
    Press,
    PressResult,
    Repaired,
    serial_of,
)
from brushloop.sessions.records import Topic

KILLED = "the process ended during it"
_R = TypeVar("_R")


class DoneTwice(ValueError):
    """A step is journalled as done twice: its strokes would appear twice."""


@dataclass(slots=True)
class RunState:
    """What the journal of a session says; `apply` is the only way in which it changes."""

    opened: Open | None = None
    closed: Closed | None = None
    done: dict[str, Done] = field(default_factory=dict[str, Done])
    """Finished steps by key; of a set-up step, the newest."""
    files: dict[str, Done] = field(default_factory=dict[str, Done])
    """Finished steps by file, in order of time; the merged file is made of these files."""
    attempts: dict[str, int] = field(default_factory=dict[str, int])
    """Attempts that were begun, by key."""
    running: dict[tuple[str, int], Begin] = field(default_factory=dict[tuple[str, int], Begin])
    """Attempts of the last process that neither finished nor were cut, by key and number."""
    cut: list[tuple[Begin, str]] = field(default_factory=list[tuple[Begin, str]])
    """Attempts that were cut, and why."""
    used_patches: set[tuple[int, int]] = field(default_factory=set[tuple[int, int]])
    """(sheet, patch) of every press that was begun, finished or not: never pressed again."""
    doubtful_sheets: set[int] = field(default_factory=set[int])
    """Sheets that may hold an unrecorded press: nothing more is pressed on them."""
    repairs: list[Repaired | Lost] = field(default_factory=list[Repaired | Lost])
    """What was repaired or lost; the merged file records it."""
    sheet: int = 0
    begun: int = 0
    """Attempts begun; the next one's serial number."""
    processes: int = 0
    ended: str = ""
    """How the last run ended; empty if its process was cut off before it could say so."""

    @property
    def voids(self) -> int:
        """Attempts that were begun and are not finished."""
        return self.begun - len(self.files)

    @property
    def is_open(self) -> bool:
        """Whether the session can be resumed. A crash before the first event left nothing to resume."""
        return self.opened is not None and self.closed is None

    def counts(self) -> dict[str, int]:
        """Messages by topic that the merged file must hold."""
        counts: Counter[str] = Counter()
        for step in self.files.values():
            counts.update(step.counts)
        return dict(counts)

    def strokes(self) -> int:
        """Strokes that the run kept."""
        return sum(step.counts.get(Topic.STROKE, 0) for step in self.files.values())

    def results(self, kind: type[_R]) -> list[_R]:
        """Results of one kind, in order of time."""
        return [step.result for step in self.files.values() if isinstance(step.result, kind)]

    def not_photographed(self) -> list[Press]:
        """Presses without a capture of the same take."""
        waiting: dict[tuple[str, int], Press] = {}
        for step in self.files.values():
            match step.result:
                case PressResult(press=press) | DrawResult(press=press):
                    waiting[press.stroke_id, press.take] = press
                case CaptureResult(press=press):
                    waiting.pop((press.stroke_id, press.take), None)
                case _:
                    pass
        return list(waiting.values())

    def apply(self, event: Event) -> None:
        """Apply the next event. Raises `DoneTwice` for a step that was done already; the state is then unchanged."""
        match event:
            case events.Open():
                self.opened = event
            case events.Process():
                self.processes += 1
                self.ended = ""
                self.cut += [(begin, KILLED) for begin in self.running.values()]
                self.running.clear()
            case events.Begin():
                self._begin(event)
            case events.Done():
                self._done(event)
            case events.Void(key=key, attempt=attempt, why=why):
                if (begin := self.running.pop((key, attempt), None)) is not None:
                    self.cut.append((begin, why))
            case events.FreshSheet(sheet=sheet):
                self.sheet = sheet
            case events.Ended(why=why):
                self.ended = why
            case events.Closed():
                self.closed = event
            case events.Repaired() | events.Lost():
                self._repair(event)
            case events.Doubt(sheet=sheet, file=file):
                self.doubtful_sheets.add(sheet)
                self.begun = max(self.begun, _next_serial(file))
            case events.Torn() | events.Remark():
                pass  # for people who read the journal

    def _begin(self, begin: Begin) -> None:
        # Serials also number stills, so that of a lost line must not be used again.
        self.begun = max(self.begun + 1, _next_serial(begin.file))
        self.attempts[begin.key] = max(self.attempts.get(begin.key, 0), begin.attempt)
        self.running[begin.key, begin.attempt] = begin
        self.sheet = max(self.sheet, begin.sheet)
        if begin.patch is not None:
            self.used_patches |= {(begin.sheet, patch) for patch in (begin.patch, *begin.more_patches)}

    def _done(self, done: Done) -> None:
        earlier, known = self.files.get(done.file), self.done.get(done.key)
        # Only a set-up step may be done again, as a later attempt.
        if known is not None and (known.attempt >= done.attempt or Topic.STROKE in {**known.counts, **done.counts}):
            earlier = known
        if earlier is not None:
            raise DoneTwice(f"says that {done.file} is done: its step was done already, in {earlier.file}")
        self.running.pop((done.key, done.attempt), None)
        self.done[done.key] = self.files[done.file] = done

    def _repair(self, repair: Repaired | Lost) -> None:
        self.repairs.append(repair)
        step = self.files.get(repair.file)
        if step is None:
            return
        current = self.done.get(step.key) is step
        if isinstance(repair, Repaired):
            step = step.model_copy(update={"sha256": repair.sha256, "counts": repair.counts})
            self.files[repair.file] = step
            if current:
                self.done[step.key] = step
            return
        del self.files[repair.file]
        if current:
            del self.done[step.key]


def _next_serial(file: str) -> int:
    serial = serial_of(file)
    return 0 if serial is None else serial + 1
