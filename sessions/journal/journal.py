"""The journal of a session: append-only JSON lines, one fsync each. What it says happened, happened.

Events: `open` (header, configs), `process` (a process opened the session), `begin` and `done` or `void` for a step
attempt, `sheet` (a fresh sheet was put in), `torn` (a half-written line was found and set aside), `clock` (the host's
clock was set back), `ended` (how a run ended before its time), `closed`. A repair adds `repaired`, `held`, `lost`,
`doubt` and `journal`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from brushloop.sessions.errors import SessionDamaged, in_one_line
from brushloop.sessions.journal import JOURNAL_NAME, Fault, Line, Reading, read, read_journal
from brushloop.sessions.journal.events import NONSENSE, check_event, serial_of
from brushloop.sessions.records import Header, Topic


@dataclass(slots=True)
class Replay:
    """State of a session after all events of its journal; a new process starts from it."""

    opened: Line | None = None
    closed: Line | None = None
    done: dict[str, Line] = field(default_factory=dict[str, Line])
    """`done` events by step key."""
    segments: list[Line] = field(default_factory=list[Line])
    """`done` events in order of time; the merged file is made of their files."""
    attempts: dict[str, int] = field(default_factory=dict[str, int])
    used_patches: set[tuple[int, int]] = field(default_factory=set[tuple[int, int]])
    """(sheet, patch) of every press that was begun, finished or not: never pressed again."""
    doubtful_sheets: set[int] = field(default_factory=set[int])
    """Sheets that may hold an unrecorded press: nothing more is pressed on them."""
    repairs: list[Line] = field(default_factory=list[Line])
    """`repaired` and `lost` events, which the merged file records."""
    sheet: int = 0
    begun: int = 0
    voids: int = 0
    ended: str = ""
    """How the last run ended; empty if its process was cut off before it could say so."""
    last_ns: int = 0
    """Time of the latest line, to notice a clock that was set back."""

    def counts(self) -> dict[str, int]:
        """Messages by topic that the merged file must hold."""
        counts: Counter[str] = Counter()
        for line in self.segments:
            counts.update(line["counts"])
        return dict(counts)


@dataclass(slots=True)
class Account:
    """Everything read from a journal, with its faults."""

    reading: Reading
    lines: list[Line] = field(default_factory=list[Line])
    """Lines that can be trusted and make sense, in the order in which they were written."""
    state: Replay = field(default_factory=Replay)
    faults: list[Fault] = field(default_factory=list[Fault])
    """All problems, in the order of the file; every command uses this list."""
    twice: list[Line] = field(default_factory=list[Line])
    """`done` lines of steps that were done already."""


def account(data: bytes, session: str = "") -> Account:
    """Read the bytes of a journal and apply its events, those of `session` if it is given, to a new state."""
    found = Account(read(data, session))
    found.faults += found.reading.faults
    for entry in found.reading.entries:
        try:
            fold(found.state, entry.line)
        except DoneTwice as error:
            found.faults.append(Fault(entry.number, str(error)))
            found.twice.append(entry.line)
        except NONSENSE as error:
            found.faults.append(Fault(entry.number, f"makes no sense: {error}"))
        else:
            found.lines.append(entry.line)
    found.faults.sort(key=lambda fault: fault.number)
    found.state.voids = found.state.begun - len(found.state.segments)
    return found


def replay(path: Path) -> Replay:
    """State after all events of a journal. Raises `SessionDamaged` where anything in it is wrong."""
    return replay_lines(path)[0]


def replay_lines(path: Path) -> tuple[Replay, list[Line]]:
    """Return the state after all events of a journal, and its lines. Raises `SessionDamaged` as `replay` does."""
    found = account(read_journal(path))
    if found.faults:
        more = f" (and {len(found.faults) - 1} more)" if len(found.faults) > 1 else ""
        raise SessionDamaged(path, f"{found.faults[0]}{more}")
    return found.state, found.lines


def read_header(folder: Path, state: Replay) -> Header:
    """Header in the journal. Raises `SessionDamaged`."""
    if state.opened is None:
        raise SessionDamaged(folder / JOURNAL_NAME, "has no `open` event")
    try:
        return Header.model_validate(state.opened["header"])
    except (KeyError, ValidationError) as error:
        raise SessionDamaged(folder / JOURNAL_NAME, f"its `open` event has no header: {in_one_line(error)}") from None


def is_open(state: Replay) -> bool:
    """Whether a session can be resumed. A crash before the first line left nothing to resume."""
    return state.opened is not None and state.closed is None


class DoneTwice(ValueError):
    """A step is journalled as done twice: its strokes would appear twice."""


def fold(state: Replay, line: Line) -> None:
    """Apply one line to the state, or raise one of `NONSENSE` and leave the state unchanged."""
    check_event(line)
    match line["event"]:
        case "open":
            state.opened = line
        case "begin":
            _begin(state, line)
        case "done":
            _check_once(state, line)
            state.done[line["key"]] = line
            state.segments.append(line)
        case "sheet":
            state.sheet = line["sheet"]
        case "closed":
            state.closed = line
        case "process" | "ended":
            state.ended = line.get("why", "")
        case "repaired" | "held" | "lost":
            _repair(state, line)
        case "doubt":
            state.doubtful_sheets.add(line["sheet"])
            state.begun = max(state.begun, _next_serial(line))
        case _:
            pass  # `void`, `clock`, `journal` and `torn` are for people who read the journal
    state.last_ns = line.get("t_ns", 0)


def _check_once(state: Replay, line: Line) -> None:
    """Raise `DoneTwice` for a step that was done already, unless it is a new attempt at a set-up step."""
    for other in state.segments:
        same = other["key"] == line["key"] and other.get("attempt", 1) == line.get("attempt", 1)
        again = other["key"] == line["key"] and Topic.STROKE in {**other["counts"], **line["counts"]}
        if same or again or other["file"] == line["file"]:
            raise DoneTwice(f"says that {line['file']} is done: its step was done already, in {other['file']}")


def _begin(state: Replay, line: Line) -> None:
    key, sheet = line["key"], line["sheet"]
    # Serials also number stills, so that of a lost line must not be used again.
    state.begun = max(state.begun + 1, _next_serial(line))
    state.attempts[key] = max(state.attempts.get(key, 0), line["attempt"])
    state.sheet = max(state.sheet, sheet)
    if line["patch"] is not None:
        state.used_patches |= {(sheet, patch) for patch in (line["patch"], *line.get("more_patches", ()))}


def _next_serial(line: Line) -> int:
    serial = serial_of(line)
    return 0 if serial is None else serial + 1


def _repair(state: Replay, line: Line) -> None:
    for at, segment in enumerate(state.segments):
        if segment["file"] != line["file"]:
            continue
        if line["event"] == "lost":
            del state.segments[at]
            if state.done.get(segment["key"], segment)["file"] == line["file"]:
                state.done.pop(segment["key"], None)
        elif line["event"] == "held":
            state.segments[at] = {**segment, "held": line["by"]}
        else:
            state.segments[at] = {**segment, "sha256": line["sha256"], "counts": line["counts"]}
        break
    if line["event"] != "held":
        state.repairs.append(line)
