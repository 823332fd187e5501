"""The lines of a journal: written one at a time, each on disk before anything depends on it, and read back as events.

A line is a JSON object with its number `seq` (1, 2, 3 ...), the id of its `session`, its time, its event, and a CRC-32
of all that as the last field. Reading reports lines that do not match their CRC, are missing, stand twice, are out of
place, are of another session or make no sense. A last line that is cut off is what a crash leaves, and is harmless. A
line that was changed and given a new CRC is not noticed.
"""

from __future__ import annotations

import gc
import json
import os
import re
import zlib
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from brushloop.sessions.disk import check_file, fsync_folder, read_bounded
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, disk_error
from brushloop.sessions.events import Done, Event, parse_event
from brushloop.sessions.records import Header
from brushloop.sessions.run_state import DoneTwice, RunState

JOURNAL_NAME = "journal.jsonl"
MAX_JOURNAL_BYTES = 256 * 1024 * 1024
"""Several times the journal of 20,000 strokes."""
Line = dict[str, Any]
_END = re.compile(rb',"crc":"([0-9a-f]{8})"\}')
_TAIL = re.compile(_END.pattern + rb"\Z")


@dataclass(frozen=True, slots=True)
class Entry:
    """One line that matches its CRC and makes sense."""

    number: int
    """Number of the line in the file as it is now, from 1."""
    seq: int
    """Number of the line as it was written, from 1."""
    session: str
    raw: bytes
    event: Event


@dataclass(frozen=True, slots=True)
class Fault:
    """Problem with one line."""

    number: int
    """Number of the line in the file as it is, from 1."""
    what: str

    def __str__(self) -> str:
        """Text such as `line 5 does not match its CRC`."""
        return f"line {self.number} {self.what}"


@dataclass(slots=True)
class Reading:
    """What a journal says, and what is wrong with it."""

    entries: list[Entry] = field(default_factory=list[Entry])
    """Lines that can be trusted, in the order in which they were written, each number once."""
    state: RunState = field(default_factory=RunState)
    """State after them."""
    faults: list[Fault] = field(default_factory=list[Fault])
    """All problems, in the order of the file; every command uses this list. Empty for a journal without damage."""
    damaged: list[int] = field(default_factory=list[int])
    """Numbers of the lines that cannot be read."""
    twice: list[Done] = field(default_factory=list[Done])
    """Steps that were done already."""
    torn: bytes = b""
    """Last line, cut off by a crash: the next process sets it aside."""
    next_seq: int = 1
    """Number of the next line."""


def encode_line(t_ns: int, line: Line, seq: int, session: str) -> bytes:
    """One line with its CRC and newline. Raises `ValueError` for values that JSON cannot hold."""
    values = {"seq": seq, "session": session, "t_ns": t_ns, **line}
    body = json.dumps(values, separators=(",", ":"), allow_nan=False).encode()
    return body[:-1] + f',"crc":"{zlib.crc32(body):08x}"}}\n'.encode()


def decode_line(raw: bytes, number: int) -> Entry:
    """Decode a line without its newline. Raises `ValueError`."""
    tail = _TAIL.search(raw)
    if tail is None or zlib.crc32(raw[: tail.start()] + b"}") != int(tail[1], 16):
        raise ValueError("does not match its CRC")
    try:
        line = cast("Line", json.loads(raw))
    except (ValueError, RecursionError):
        raise ValueError("is not JSON") from None
    match line:
        case {"seq": int(seq), "session": str(session), "event": str()} if seq > 0 and not isinstance(seq, bool):
            for name in ("seq", "session", "crc"):
                del line[name]
        case _:
            raise ValueError("has no number, session or event")
    try:
        return Entry(number, seq, session, raw, parse_event(line))
    except ValueError as error:
        raise ValueError(f"makes no sense: {error}") from None


def read_journal(path: Path) -> bytes:
    """Bytes of a journal. Raises `SessionError`, `SessionDamaged` if it is too large, and `InputError` for a link."""
    if check_file(path) and path.stat().st_size > MAX_JOURNAL_BYTES:
        raise SessionDamaged(path, f"is larger than {MAX_JOURNAL_BYTES} bytes")
    try:
        return read_bounded(path, MAX_JOURNAL_BYTES)
    except InputError as error:
        raise SessionError(path, error.what) from None


def read(data: bytes, session: str = "") -> Reading:
    """Read whatever is intact in the bytes of a journal.

    Lines of another session than `session` are not used; without it, those of the session with most lines are.
    """
    with _without_collection():
        reading = Reading()
        entries = _in_order(reading, _decoded(reading, data), session)
        _missing(reading, entries)
        for entry in entries:
            try:
                reading.state.apply(entry.event)
            except DoneTwice as error:
                reading.faults.append(Fault(entry.number, str(error)))
                reading.twice += [entry.event] if isinstance(entry.event, Done) else []
            else:
                reading.entries.append(entry)
        reading.faults.sort(key=lambda fault: fault.number)
        return reading


def replay(path: Path) -> RunState:
    """State after all events of a journal. Raises `SessionDamaged` where anything in it is wrong."""
    return undamaged(path).state


def undamaged(path: Path) -> Reading:
    """A journal whose every line can be trusted. Raises `SessionDamaged` for any other."""
    reading = read(read_journal(path))
    if reading.faults:
        more = f" (and {len(reading.faults) - 1} more)" if len(reading.faults) > 1 else ""
        raise SessionDamaged(path, f"{reading.faults[0]}{more}")
    return reading


def read_header(folder: Path, state: RunState) -> Header:
    """Header in the journal. Raises `SessionDamaged`."""
    if state.opened is None:
        raise SessionDamaged(folder / JOURNAL_NAME, "has no `open` event")
    return state.opened.header


@contextmanager
def _without_collection() -> Generator[None]:
    """Within the block, cyclic garbage is not collected: of the many small objects of a long journal none is garbage,
    and looking at all of them again and again takes more time than reading them."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _decoded(reading: Reading, data: bytes) -> list[Entry]:
    """Lines that can be used; the others are reported."""
    *pieces, tail = data.split(b"\n")
    entries: list[Entry] = []
    for number, raw in enumerate([*pieces, tail] if tail else pieces, start=1):
        try:
            entries.append(decode_line(raw, number))
        except ValueError as error:
            if number > len(pieces) and _END.search(raw) is None:
                reading.torn = tail
            else:
                reading.faults.append(Fault(number, str(error)))
                # Lines between which the newline is damaged stand as one.
                reading.damaged += [number] * max(1, raw.count(b'{"seq":'))
    return entries


def _in_order(reading: Reading, entries: list[Entry], session: str) -> list[Entry]:
    """The lines of the session as they were written; those of others, or doubled or moved ones, are reported."""
    if entries and not session:
        session = Counter(entry.session for entry in entries).most_common(1)[0][0]
    foreign: dict[str, list[Entry]] = {}
    by_seq: dict[int, Entry] = {}
    for entry in entries:
        if entry.session != session:
            foreign.setdefault(entry.session, []).append(entry)
        elif (known := by_seq.setdefault(entry.seq, entry)) is not entry:
            how = "stands twice: it is" if known.raw == entry.raw else "stands in the place of"
            reading.faults.append(Fault(entry.number, f"{how} line {entry.seq}"))
    for other, lines in foreign.items():
        reading.faults.append(_one_of(lines, f"is of another session, {other[:100]!r}"))
    as_they_stand = list(by_seq.values())
    as_written = [by_seq[seq] for seq in sorted(by_seq)]
    moved = [one for one, other in zip(as_they_stand, as_written, strict=True) if one is not other]
    if moved:
        reading.faults.append(_one_of(moved, f"is out of place: it was written as line {moved[0].seq}"))
    reading.next_seq = as_written[-1].seq + 1 if as_written else 1
    return as_written


def _one_of(lines: list[Entry], what: str) -> Fault:
    return Fault(lines[0].number, what + (f" (and {len(lines) - 1} more)" if len(lines) > 1 else ""))


def _missing(reading: Reading, entries: list[Entry]) -> None:
    """Report numbers that no line has, except those of lines that cannot be read."""
    seq = at = 0
    for entry in entries:
        gone = entry.seq - seq - 1
        if gone > 0:
            gone -= sum(at < number < entry.number for number in reading.damaged)
        if gone > 0:
            lines = "a line that is" if gone == 1 else f"{gone} lines that are"
            reading.faults.append(Fault(entry.number, f"comes after {lines} missing"))
        seq, at = entry.seq, max(at, entry.number)


class Journal:
    """Writer that appends to one journal file. The caller holds the session's lock, so only one process writes.

    `t_ns`, the time of opening, dates the note about a torn tail. Raises `SessionError` where the disk fails, and
    `InputError` where the file is a link.
    """

    def __init__(self, path: Path, t_ns: int, session: str = "") -> None:
        self.path = path
        self._session = session
        try:
            created = not check_file(path)
            self._seq = 1 if created else _whole_lines(path, t_ns, session)
            self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            self._size = os.fstat(self._fd).st_size
            if created:
                fsync_folder(path.parent)
        except OSError as error:
            raise disk_error(path, "cannot open", error) from error

    def append(self, t_ns: int, line: Line) -> None:
        """Write one event and wait until it is on disk. Raises `SessionError` where that fails."""
        data = encode_line(t_ns, line, self._seq, self._session)
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
        self._seq += 1

    def close(self) -> None:
        """Close the file; the session stays open until there is a `closed` event."""
        os.close(self._fd)


def _whole_lines(path: Path, t_ns: int, session: str) -> int:
    """Make the journal end with a whole line, and return the number of the next one."""
    data = read_journal(path)
    reading = read(data)
    seq = reading.next_seq
    keep = data.rfind(b"\n") + 1
    if keep == len(data):
        return seq
    if reading.torn:
        # Longer than the tail that it overwrites, and written in one call: a crash leaves the tail or the note.
        note, at = encode_line(t_ns, {"event": "torn", "hex": data[keep:].hex()}, seq, session), keep
    else:
        note, at = b"\n", len(data)  # only the newline was cut off
    with path.open("r+b", buffering=0) as file:
        file.seek(at)
        file.write(note)
        os.fsync(file.fileno())
    return seq + bool(reading.torn)
