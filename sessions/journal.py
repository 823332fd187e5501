"""The journal of a session: append-only JSON lines, one fsync each. What it says happened, happened.

Events: `open` (header, configs), `process` (a process took the session), `begin` and `done` or `void` for a step
attempt, `sheet` (a fresh sheet was put in), `torn` (a half-written line was found and set aside), `clock` (the host's
clock was set back), `closed`. A repair adds `repaired`, `held`, `lost`, `doubt` and `journal`.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

from sessions.errors import SessionDamaged, disk_error
from sessions.lines import Line, encode_line
from sessions.lines import read_lines as read_lines
from sessions.schemas import TornTail

JOURNAL_NAME = "journal.jsonl"
_SERIAL = re.compile(r"\d+(?=-)")
DONE_FIELDS = {"key": str, "kind": str, "file": str, "sha256": str, "counts": dict, "result": dict}


class Journal:
    """Appends to one journal file. One process at a time: the caller holds the session's lock.

    `t_ns` is when it is opened, for the note about a torn tail. Raises `SessionError` where the disk fails.
    """

    def __init__(self, path: Path, t_ns: int) -> None:
        self.path = path
        try:
            created = not path.exists()
            if not created:
                _set_torn_tail_aside(path, t_ns)
            self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            self._size = os.fstat(self._fd).st_size
            if created:
                fsync_folder(path.parent)
        except OSError as error:
            raise disk_error(path, "cannot open", error) from error

    def append(self, t_ns: int, line: Line) -> None:
        """Write one event and wait until it is on disk. Raises `SessionError` where that fails."""
        data = encode_line(t_ns, line)
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


def _set_torn_tail_aside(path: Path, t_ns: int) -> None:
    data = path.read_bytes()
    keep = data.rfind(b"\n") + 1
    if keep == len(data):
        return
    # Longer than what it overwrites, and one write: a crash here leaves the old tail or the note, never neither.
    note = encode_line(t_ns, TornTail(hex=data[keep:].hex()).model_dump())
    with path.open("r+b", buffering=0) as file:
        file.seek(keep)
        file.write(note)
        os.fsync(file.fileno())


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


def replay(path: Path) -> Replay:
    """Fold a journal. Raises `SessionDamaged` where it makes no sense."""
    state = Replay()
    for line in read_lines(path):
        try:
            fold(state, line)
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise SessionDamaged(path, f"event {line['event']!r} lacks or spoils {error}") from None
    state.voids = state.begun - len(state.segments)
    return state


def is_open(state: Replay) -> bool:
    """Whether a session can be gone on with. A crash before the first line left nothing to go on with."""
    return state.opened is not None and state.closed is None


def fold(state: Replay, line: Line) -> None:
    """Take one line into the memory. Raises `KeyError`, `TypeError`, `ValueError` for what makes no sense."""
    state.last_ns = int(line.get("t_ns", 0))
    match line["event"]:
        case "open":
            state.opened = line
        case "begin":
            _begin(state, line)
        case "done":
            for name, kind in DONE_FIELDS.items():
                if not isinstance(line[name], kind):
                    raise TypeError(name)
            _check_counts(line["counts"])
            state.done[str(line["key"])] = line
            state.segments.append(line)
        case "sheet":
            state.sheet = int(line["sheet"])
        case "closed":
            state.closed = line
        case "repaired" | "held" | "lost":
            _repair(state, line)
        case "doubt":
            state.doubtful_sheets.add(int(line["sheet"]))
            state.begun = max(state.begun, _next_serial(line))
        case _:
            pass  # `process`, `void`, `clock`, `journal` and `torn` are for people who read the journal


def _begin(state: Replay, line: Line) -> None:
    key, sheet = str(line["key"]), int(line["sheet"])
    # A line that was lost must not give its number, which names stills as well, to another attempt.
    state.begun = max(state.begun + 1, _next_serial(line))
    state.attempts[key] = max(state.attempts.get(key, 0), int(line["attempt"]))
    state.sheet = max(state.sheet, sheet)
    if line["cell"] is not None:
        state.used_cells |= {(sheet, int(cell)) for cell in (line["cell"], *line.get("more_cells", ()))}


def _next_serial(line: Line) -> int:
    serial = _SERIAL.match(str(line.get("file", "")))
    return int(serial[0]) + 1 if serial else 0


def _repair(state: Replay, line: Line) -> None:
    file = str(line["file"])
    for at, segment in enumerate(state.segments):
        if segment["file"] != file:
            continue
        key = str(segment["key"])
        if line["event"] == "lost":
            del state.segments[at]
            if state.done.get(key, segment)["file"] == file:
                state.done.pop(key, None)
        elif line["event"] == "held":
            state.segments[at] = {**segment, "held": str(line["by"])}
        else:
            _check_counts(line["counts"])
            state.segments[at] = {**segment, "sha256": str(line["sha256"]), "counts": line["counts"]}
        break
    if line["event"] != "held":
        state.repairs.append(line)


def _check_counts(counts: Line) -> None:
    if not all(type(count) is int for count in counts.values()):
        raise TypeError("counts")
