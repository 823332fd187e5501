"""The lines of a journal: written one at a time, each on disk before anything depends on it, and read back.

A line is a JSON object with its number `seq` (1, 2, 3 ...), the id of its `session`, its time, its event, and a CRC-32
of all that as the last field. Reading reports lines that do not match their CRC, are missing, stand twice, are out of
place or are of another session. A last line that is cut off is what a crash leaves, and is harmless. A line that was
changed and given a new CRC is not noticed.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from brushloop.sessions.disk import check_file, fsync_folder, read_bounded
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, disk_error

JOURNAL_NAME = "journal.jsonl"
MAX_JOURNAL_BYTES = 256 * 1024 * 1024
"""Several times the journal of 20,000 strokes."""
Line = dict[str, Any]
_TAIL = re.compile(rb',"crc":"([0-9a-f]{8})"\}\Z')
_WHOLE = re.compile(rb'\{"seq":.*?,"crc":"[0-9a-f]{8}"\}', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Entry:
    """One line that matches its CRC."""

    number: int
    """Number of the line in the file as it is now, from 1."""
    seq: int
    """Number of the line as it was written, from 1."""
    session: str
    raw: bytes
    line: Line
    """Time and event."""


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
    """Lines of a journal that can be used, and what is wrong with the rest."""

    entries: list[Entry] = field(default_factory=list[Entry])
    """In the order in which they were written, each number once."""
    faults: list[Fault] = field(default_factory=list[Fault])
    """In the order of the file; empty for a journal without damage."""
    damaged: list[int] = field(default_factory=list[int])
    """Numbers of the lines that cannot be read."""
    torn: bytes = b""
    """Last line, cut off by a crash: the next process sets it aside."""


class BadLine(Exception):
    """A line cannot be used; the message says why."""


def encode_line(t_ns: int, line: Line, seq: int, session: str) -> bytes:
    """One line with its CRC and newline. Raises `ValueError` for values that JSON cannot hold."""
    values = {"seq": seq, "session": session, "t_ns": t_ns, **line}
    body = json.dumps(values, separators=(",", ":"), allow_nan=False).encode()
    return body[:-1] + f',"crc":"{zlib.crc32(body):08x}"}}\n'.encode()


def without_time(line: Line) -> Line:
    """The line without its time, which `encode_line` adds."""
    return {name: value for name, value in line.items() if name != "t_ns"}


def decode_line(raw: bytes, number: int) -> Entry:
    """Decode a line without its newline. Raises `BadLine`."""
    tail = _TAIL.search(raw)
    if tail is None or zlib.crc32(raw[: tail.start()] + b"}") != int(tail[1], 16):
        raise BadLine("does not match its CRC")
    try:
        line = cast("Line", json.loads(raw))
    except (ValueError, RecursionError):
        raise BadLine("is not JSON") from None
    match line:
        case {"seq": int(seq), "session": str(session), "event": str()} if seq > 0 and not isinstance(seq, bool):
            for name in ("seq", "session", "crc"):
                del line[name]
            return Entry(number, seq, session, raw, line)
        case _:
            raise BadLine("has no number, session or event")


def read_journal(path: Path) -> bytes:
    """Bytes of a journal. Raises `SessionError`, `SessionDamaged` if it is too large, and `InputError` for a link."""
    if check_file(path) and path.stat().st_size > MAX_JOURNAL_BYTES:
        raise SessionDamaged(path, f"is larger than {MAX_JOURNAL_BYTES} bytes")
    try:
        return read_bounded(path, MAX_JOURNAL_BYTES)
    except InputError as error:
        raise SessionError(path, error.what) from None


def read_lines(path: Path) -> Iterator[Line]:
    """Complete lines, without a torn last one; any other damage raises `SessionDamaged`."""
    reading = read(read_journal(path))
    if reading.faults:
        raise SessionDamaged(path, str(reading.faults[0]))
    return iter([entry.line for entry in reading.entries])


def read(data: bytes, session: str = "") -> Reading:
    """Read whatever is intact in the bytes of a journal.

    Lines of another session than `session` are not used; without it, those of the session with most lines are.
    """
    reading = Reading()
    entries = _decoded(reading, data)
    if entries and not session:
        session = Counter(entry.session for entry in entries).most_common(1)[0][0]
    foreign = [entry for entry in entries if entry.session != session]
    for other in dict.fromkeys(entry.session for entry in foreign):
        first, *others = [entry.number for entry in foreign if entry.session == other]
        more = f", as are {len(others)} more" if others else ""
        reading.faults.append(Fault(first, f"is of another session, {other[:100]!r}{more}"))
    by_seq: dict[int, Entry] = {}
    for entry in entries:
        if entry.session == session:
            known = by_seq.setdefault(entry.seq, entry)
            if known is not entry:
                how = "stands twice: it is" if known.raw == entry.raw else "stands in the place of"
                reading.faults.append(Fault(entry.number, f"{how} line {entry.seq}"))
    reading.entries = [by_seq[seq] for seq in sorted(by_seq)]
    _misplaced(reading)
    _missing(reading)
    reading.faults.sort(key=lambda fault: fault.number)
    return reading


def _decoded(reading: Reading, data: bytes) -> list[Entry]:
    """Lines that match their CRC, even if the newline between two of them is damaged."""
    *pieces, tail = data.split(b"\n")
    entries: list[Entry] = []
    for number, raw in enumerate([*pieces, tail] if tail else pieces, start=1):
        try:
            entries.append(decode_line(raw, number))
        except BadLine as error:
            within, left = _lines_within(raw, number)
            entries += within
            if number > len(pieces) and not within:
                reading.torn = tail
                continue
            reading.faults.append(Fault(number, "has a damaged end" if within and not left else str(error)))
            reading.damaged += [number] * left
    return entries


def _lines_within(raw: bytes, number: int) -> tuple[list[Entry], int]:
    """The lines in a span with a damaged newline, and the number of damaged lines between them."""
    entries: list[Entry] = []
    at = left = 0
    for match in _WHOLE.finditer(raw):
        try:
            entries.append(decode_line(match[0], number))
        except BadLine:
            continue
        left += match.start() - at > 1  # a single byte was the newline
        at = match.end()
    return entries, left + (len(raw) - at > 1 or not entries)


def _misplaced(reading: Reading) -> None:
    """Report lines outside the longest run that is in order."""
    held = reading.entries
    if all(one.number < after.number for one, after in pairwise(held)):
        return
    ends: list[int] = []
    """Index of the last entry of the best run of each length."""
    before: list[int | None] = []
    for index, entry in enumerate(held):
        at = bisect_right(ends, entry.number, key=lambda end: held[end].number)
        before.append(ends[at - 1] if at else None)
        ends[at : at + 1] = [index]
    in_order: set[int] = set()
    index = ends[-1] if ends else None
    while index is not None:
        in_order.add(index)
        index = before[index]
    for index, entry in enumerate(held):
        if index not in in_order:
            reading.faults.append(Fault(entry.number, f"is out of place: it was written as line {entry.seq}"))


def _missing(reading: Reading) -> None:
    """Report numbers that no line has, except those of lines that cannot be read."""
    seq = at = 0
    for entry in reading.entries:
        gone = entry.seq - seq - 1 - sum(at < number < entry.number for number in set(reading.damaged))
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
    seq = reading.entries[-1].seq + 1 if reading.entries else 1
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
