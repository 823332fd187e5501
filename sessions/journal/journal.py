"""The journal of a session: append-only JSON lines, one fsync each. What it says happened, happened.

Events: `open` (header, configs), `process` (a process took the session), `begin` and `done` or `void` for a step
attempt, `sheet` (a fresh sheet was put in), `torn` (a half-written line was found and set aside), `clock` (the host's
clock was set back), `closed`. A repair adds `repaired`, `held`, `lost`, `doubt` and `journal`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from sessions.errors import SessionDamaged, disk_error
from sessions.journal.codec import Chain, Line, digest, encode_line
from sessions.journal.events import NONSENSE, check_event, serial_of
from sessions.journal.lines import Fault, Reading, read, read_journal
from sessions.journal.lines import read_lines as read_lines
from sessions.names import check_file
from sessions.recording.schemas import Topic, TornTail

JOURNAL_NAME = "journal.jsonl"


class Journal:
    """Appends to one journal file. One process at a time: the caller holds the session's lock.

    `t_ns` is when it is opened, for the note about a torn tail. Lines are chained where `session`, an id, is given:
    from the first line on, or from here on where the lines so far are not. Raises `SessionError` where the disk
    fails, and `InputError` where the file is a link.
    """

    def __init__(self, path: Path, t_ns: int, session: str = "") -> None:
        self.path = path
        self._session = session
        try:
            created = not check_file(path)
            self._next = None if created else _whole_lines(path, t_ns, session)
            if created:
                self._next = next_chain(b"", session)
            self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            self._size = os.fstat(self._fd).st_size
            if created:
                fsync_folder(path.parent)
        except OSError as error:
            raise disk_error(path, "cannot open", error) from error

    def append(self, t_ns: int, line: Line) -> None:
        """Write one event and wait until it is on disk. Raises `SessionError` where that fails."""
        data = encode_line(t_ns, line, self._next)
        try:
            if os.fstat(self._fd).st_size != self._size:
                os.ftruncate(self._fd, self._size)  # part of a line that did not fit on the disk
            view = memoryview(data)
            while view:
                view = view[os.write(self._fd, view) :]
            os.fsync(self._fd)
        except OSError as error:
            raise disk_error(self.path, "cannot write", error) from error
        self._size += len(data)
        self._next = _after(self._next, data)

    def close(self) -> None:
        """Close the file; the session stays open until a `closed` event says otherwise."""
        os.close(self._fd)


def fsync_folder(folder: Path) -> None:
    """Make a rename or a new file in `folder` durable."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def next_chain(data: bytes, session: str) -> Chain | None:
    """What the next line of a journal with these bytes, all of them whole lines, carries; None without a session."""
    if not session:
        return None
    *lines, _end = data.split(b"\n")
    chained = bool(lines) and not read(lines[-1] + b"\n").unchained
    return Chain(len(lines) + 1, session, digest(lines[-1] if chained else data))


def _after(chain: Chain | None, data: bytes) -> Chain | None:
    return None if chain is None else Chain(chain.seq + 1, chain.session, digest(data.rstrip(b"\n")))


def _whole_lines(path: Path, t_ns: int, session: str) -> Chain | None:
    """Make the journal end with a whole line; returns what the next one carries."""
    data = read_journal(path)
    keep = data.rfind(b"\n") + 1
    if keep == len(data):
        return next_chain(data, session)
    chain = next_chain(data[:keep], session)
    if read(data).torn:
        # Longer than what it overwrites, and one write: a crash here leaves the old tail or the note, never neither.
        note, at = encode_line(t_ns, TornTail(hex=data[keep:].hex()).model_dump(), chain), keep
    else:
        note, at = b"\n", len(data)  # only that was cut off
    with path.open("r+b", buffering=0) as file:
        file.seek(at)
        file.write(note)
        os.fsync(file.fileno())
    return next_chain(data[:at] + note, session)


@dataclass(slots=True)
class Replay:
    """What a journal says, folded: the memory that a new process starts from."""

    opened: Line | None = None
    closed: Line | None = None
    done: dict[str, Line] = field(default_factory=dict[str, Line])
    """`done` events by step key."""
    segments: list[Line] = field(default_factory=list[Line])
    """`done` events in order of time: what the merged file is made of."""
    attempts: dict[str, int] = field(default_factory=dict[str, int])
    used_cells: set[tuple[int, int]] = field(default_factory=set[tuple[int, int]])
    """(sheet, cell) of every press that was begun, finished or not: never to be pressed again."""
    doubtful_sheets: set[int] = field(default_factory=set[int])
    """Sheets on which a press may lie that nobody knows of: nothing more is pressed on them."""
    repairs: list[Line] = field(default_factory=list[Line])
    """`repaired` and `lost` events: what the merged file has to tell of."""
    sheet: int = 0
    begun: int = 0
    voids: int = 0
    last_ns: int = 0
    """Time of the latest line, to notice a clock that was set back."""


@dataclass(slots=True)
class Account:
    """A journal, read and folded: what it says, and what in it makes no sense."""

    reading: Reading
    lines: list[Line] = field(default_factory=list[Line])
    """Lines that can be trusted and make sense, in the order in which they were written."""
    state: Replay = field(default_factory=Replay)
    faults: list[Fault] = field(default_factory=list[Fault])
    """Everything that is wrong, in the order of the file: the one list that all commands go by."""
    spoilt: list[bytes] = field(default_factory=list[bytes])
    """Lines that are there, and say nothing."""
    twice: list[Line] = field(default_factory=list[Line])
    """Lines that say of a step that it is done though it is."""


def account(data: bytes) -> Account:
    """What the bytes of a journal say. Raises nothing."""
    found = Account(read(data))
    found.faults += found.reading.faults
    found.spoilt += [span for _, span in found.reading.spoilt]
    for entry in found.reading.entries:
        try:
            fold(found.state, entry.line)
        except DoneTwice as error:
            found.faults.append(Fault(entry.number, str(error)))
            found.twice.append(entry.line)
        except NONSENSE as error:
            found.faults.append(Fault(entry.number, f"makes no sense: {error}"))
            found.spoilt.append(entry.raw)
        else:
            found.lines.append(entry.line)
    found.faults.sort(key=lambda fault: fault.number)
    found.state.voids = found.state.begun - len(found.state.segments)
    return found


def replay(path: Path) -> Replay:
    """Fold a journal. Raises `SessionDamaged` where anything in it is wrong."""
    return replay_lines(path)[0]


def replay_lines(path: Path) -> tuple[Replay, list[Line]]:
    """The same, and the lines themselves."""
    found = account(read_journal(path))
    if found.faults:
        more = f" (and {len(found.faults) - 1} more)" if len(found.faults) > 1 else ""
        raise SessionDamaged(path, f"{found.faults[0]}{more}")
    return found.state, found.lines


def is_open(state: Replay) -> bool:
    """Whether a session can be gone on with. A crash before the first line left nothing to go on with."""
    return state.opened is not None and state.closed is None


class DoneTwice(ValueError):
    """A step is journalled as done that is done already: its strokes would be there twice."""


def fold(state: Replay, line: Line) -> None:
    """Take one line into the memory, or raise one of `NONSENSE` and leave the memory as it was."""
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
        case "repaired" | "held" | "lost":
            _repair(state, line)
        case "doubt":
            state.doubtful_sheets.add(line["sheet"])
            state.begun = max(state.begun, _next_serial(line))
        case _:
            pass  # `process`, `void`, `clock`, `journal` and `torn` are for people who read the journal
    state.last_ns = line.get("t_ns", 0)


def _check_once(state: Replay, line: Line) -> None:
    """Set-up steps are done again under one key, each time as another attempt; a stroke never is."""
    for other in state.segments:
        same = other["key"] == line["key"] and other.get("attempt", 1) == line.get("attempt", 1)
        again = other["key"] == line["key"] and Topic.STROKE in {**other["counts"], **line["counts"]}
        if same or again or other["file"] == line["file"]:
            raise DoneTwice(f"says that {line['file']} is done: its step was done already, in {other['file']}")


def _begin(state: Replay, line: Line) -> None:
    key, sheet = line["key"], line["sheet"]
    # A line that was lost must not give its number, which names stills as well, to another attempt.
    state.begun = max(state.begun + 1, _next_serial(line))
    state.attempts[key] = max(state.attempts.get(key, 0), line["attempt"])
    state.sheet = max(state.sheet, sheet)
    if line["cell"] is not None:
        state.used_cells |= {(sheet, cell) for cell in (line["cell"], *line.get("more_cells", ()))}


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
