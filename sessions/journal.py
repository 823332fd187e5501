"""The journal of a session: append-only JSON lines, one fsync each. What it says happened, happened.

Events: `open` (header, configs), `process` (a process took the session), `begin` and `done` or `void` for a step
attempt, `sheet` (a fresh sheet was put in), `torn` (a half-written line was found and set aside), `closed`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sessions.errors import SessionDamaged, SessionError, in_one_line
from sessions.schemas import TornTail

JOURNAL_NAME = "journal.jsonl"
Line = dict[str, Any]
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
            raise SessionError(path, f"cannot open: {in_one_line(error)}") from error

    def append(self, t_ns: int, line: Line) -> None:
        """Write one event and wait until it is on disk. Raises `SessionError` where that fails."""
        data = _encode(t_ns, line)
        try:
            if os.fstat(self._fd).st_size != self._size:
                os.ftruncate(self._fd, self._size)  # part of a line that did not fit on the disk
            view = memoryview(data)
            while view:
                view = view[os.write(self._fd, view) :]
            os.fsync(self._fd)
        except OSError as error:
            raise SessionError(self.path, f"cannot write: {in_one_line(error)}") from error
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


def read_lines(path: Path) -> Iterator[Line]:
    """Every complete line. A torn last line is left out; damage anywhere else raises `SessionDamaged`."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SessionError(path, f"cannot read: {in_one_line(error)}") from None
    for number, raw in enumerate(data.split(b"\n")[:-1], start=1):
        try:
            line = json.loads(raw)
        except (ValueError, RecursionError):
            raise SessionDamaged(path, f"line {number} is not JSON") from None
        if not isinstance(line, dict) or not isinstance(line.get("event"), str):  # pyright: ignore[reportUnknownMemberType]
            raise SessionDamaged(path, f"line {number} has no event")
        yield line


def _encode(t_ns: int, line: Line) -> bytes:
    return json.dumps({"t_ns": t_ns, **line}, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _set_torn_tail_aside(path: Path, t_ns: int) -> None:
    data = path.read_bytes()
    keep = data.rfind(b"\n") + 1
    if keep == len(data):
        return
    # Longer than what it overwrites, and one write: a crash here leaves the old tail or the note, never neither.
    note = _encode(t_ns, TornTail(hex=data[keep:].hex()).model_dump())
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
    sheet: int = 0
    begun: int = 0
    voids: int = 0


def replay(path: Path) -> Replay:
    """Fold a journal. Raises `SessionDamaged` where it makes no sense."""
    state = Replay()
    for line in read_lines(path):
        try:
            _fold(state, line)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise SessionDamaged(path, f"event {line['event']!r} lacks or spoils {error}") from None
    state.voids = state.begun - len(state.segments)
    return state


def is_open(state: Replay) -> bool:
    """Whether a session can be gone on with. A crash before the first line left nothing to go on with."""
    return state.opened is not None and state.closed is None


def _fold(state: Replay, line: Line) -> None:
    match line["event"]:
        case "open":
            state.opened = line
        case "begin":
            key = str(line["key"])
            state.begun += 1
            state.attempts[key] = max(state.attempts.get(key, 0), int(line["attempt"]))
            if line["cell"] is not None:
                state.used_cells.add((int(line["sheet"]), int(line["cell"])))
        case "done":
            for name, kind in DONE_FIELDS.items():
                if not isinstance(line[name], kind):
                    raise TypeError(name)
            if not all(type(count) is int for count in line["counts"].values()):
                raise TypeError("counts")
            state.done[str(line["key"])] = line
            state.segments.append(line)
        case "sheet":
            state.sheet = int(line["sheet"])
        case "closed":
            state.closed = line
        case _:
            pass  # `process`, `void` and `torn` are for people who read the journal
