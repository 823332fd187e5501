"""The lines of a journal: written one at a time, each on disk before anything depends on it, and read back as events.

`RunState` is the state of a run after them, and its only memory: resume, screens, review, lists and repair read it.

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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast

from brushloop.sessions import events
from brushloop.sessions.disk import check_file, fsync_folder, read_bounded
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, disk_error
from brushloop.sessions.events import Begin, Done, Event, Lost, Repaired, parse_event, serial_of
from brushloop.sessions.records import Header, Topic

JOURNAL_NAME = "journal.jsonl"
RIG_EFFECTIVE, PROTOCOL_EFFECTIVE = "rig.effective.json", "protocol.effective.json"
MAX_JOURNAL_BYTES = 256 * 1024 * 1024
"""Several times the journal of 20,000 strokes."""
Line = dict[str, Any]
_END = re.compile(rb',"crc":"([0-9a-f]{8})"\}')
_TAIL = re.compile(_END.pattern + rb"\Z")
KILLED = "the process ended during the step"
_R = TypeVar("_R")


class DoneTwice(ValueError):
    """A step is journalled as done twice: its strokes would appear twice."""


@dataclass(slots=True)
class RunState:
    """What the journal of a session says; `apply` is the only way in which it changes."""

    opened: events.Open | None = None
    closed: events.Closed | None = None
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
    ended: str = ""
    """How the last run ended; empty if its process was cut off before it could say so."""

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

    def results(self, kind: type[_R]) -> list[_R]:
        """Results of one kind, in order of time."""
        return [step.result for step in self.files.values() if isinstance(step.result, kind)]

    def apply(self, event: Event) -> None:
        """Apply the next event. Raises `DoneTwice` for a step that was done already; the state is then unchanged."""
        match event:
            case events.Open():
                self.opened = event
            case events.Process():
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
                self.begun = max(self.begun, serial_of(file) + 1)
            case events.Remark():
                pass  # of a journal of its own

    def _begin(self, begin: Begin) -> None:
        # Serials also number stills, so that of a lost line must not be used again.
        self.begun = max(self.begun, serial_of(begin.file)) + 1
        self.attempts[begin.key] = max(self.attempts.get(begin.key, 0), begin.attempt)
        self.running[begin.key, begin.attempt] = begin
        self.sheet = max(self.sheet, begin.sheet)
        self.used_patches |= {(begin.sheet, patch) for patch in begin.patches}

    def _done(self, done: Done) -> None:
        earlier, known = self.files.get(done.file), self.done.get(done.key)
        # Only a set-up step may be done again, as a later attempt.
        if known is not None and (known.attempt >= done.attempt or Topic.STROKE in {**known.counts, **done.counts}):
            earlier = known
        if earlier is not None:
            raise DoneTwice(f"says that {done.file} is done, but {earlier.file} had done the same step before")
        self.running.pop((done.key, done.attempt), None)
        self.done[done.key] = self.files[done.file] = done

    def _repair(self, repair: Repaired | Lost) -> None:
        self.repairs.append(repair)
        if (step := self.files.get(repair.file)) is None:
            return
        for steps, name in ((self.files, step.file), (self.done, step.key)):
            if steps.get(name) is step:
                if isinstance(repair, Lost):
                    del steps[name]
                else:
                    steps[name] = step.model_copy(update={"sha256": repair.sha256, "counts": repair.counts})


@dataclass(frozen=True, slots=True)
class Entry:
    """One line that matches its CRC and makes sense."""

    number: int
    """Number of the line in the file as it is now, from 1."""
    seq: int
    """Number of the line as it was written, from 1."""
    session: str
    event: Event


@dataclass(slots=True)
class Reading:
    """What a journal says, and what is wrong with it."""

    events: list[Event] = field(default_factory=list[Event])
    """Those of lines that can be trusted, in the order in which they were written, each once."""
    state: RunState = field(default_factory=RunState)
    """State after them."""
    faults: list[str] = field(default_factory=list[str])
    """All problems, such as `line 5 does not match its CRC`; every command uses this list. Empty without damage."""
    missing: int = 0
    """Number of lines that are gone from between others."""
    unread: int = 0
    """Number of lines behind the last one that can be read."""
    torn: bytes = b""
    """Last line, cut off by a crash: the next process removes it."""
    next_seq: int = 1
    """Number of the next line."""


def encode_line(event: Event, seq: int, session: str) -> bytes:
    """The line of an event with its CRC and newline."""
    return seal({"seq": seq, "session": session, **event.model_dump(mode="json", exclude_none=True)})


def seal(line: Line) -> bytes:
    """A line with its CRC and newline. Raises `ValueError` for values that JSON cannot hold."""
    body = json.dumps(line, separators=(",", ":"), allow_nan=False).encode()
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
            raise ValueError("lacks its number, session or event")
    try:
        return Entry(number, seq, session, parse_event(line))
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
    reading = Reading()
    collects = gc.isenabled()
    gc.disable()  # none of a long journal's many small objects is garbage, and looking at them takes more than reading
    try:
        for entry in _in_order(reading, _decoded(reading, data), session):
            try:
                reading.state.apply(entry.event)
                reading.events.append(entry.event)
            except DoneTwice as error:
                reading.faults.append(f"line {entry.number} {error}")
    finally:
        if collects:
            gc.enable()
    return reading


def replay(path: Path) -> RunState:
    """State after all events of a journal. Raises `SessionDamaged` where anything in it is wrong."""
    return undamaged(path).state


def undamaged(path: Path) -> Reading:
    """A journal whose every line can be trusted. Raises `SessionDamaged` for any other."""
    reading = read(read_journal(path))
    if reading.faults:
        raise SessionDamaged(path, f"{'; '.join(reading.faults[:3])}")
    return reading


def read_header(folder: Path, state: RunState) -> Header:
    """Header in the journal. Raises `SessionDamaged`."""
    if state.opened is None:
        raise SessionDamaged(folder / JOURNAL_NAME, "has no `open` event")
    return state.opened.header


def _decoded(reading: Reading, data: bytes) -> list[Entry]:
    """Lines that can be used; the others are reported."""
    *pieces, tail = data.split(b"\n")
    lines = [*pieces, tail] if tail else pieces
    entries: list[Entry] = []
    for number, raw in enumerate(lines, start=1):
        try:
            entries.append(decode_line(raw, number))
        except ValueError as error:
            if number > len(pieces) and _END.search(raw) is None:
                reading.torn = tail
            else:
                reading.faults.append(f"line {number} {error}")
    reading.unread = len(lines) - bool(reading.torn) - (entries[-1].number if entries else 0)
    return entries


def _in_order(reading: Reading, entries: list[Entry], session: str) -> list[Entry]:
    """The lines of the session as they were written; those of others, or lines that stand elsewhere, are reported."""
    if entries and not session:
        session = Counter(entry.session for entry in entries).most_common(1)[0][0]
    own = [entry for entry in entries if entry.session == session]
    for entry in [entry for entry in entries if entry.session != session][:1]:
        reading.faults.append(f"line {entry.number} is of another session, {entry.session[:100]!r}")
    for entry in [entry for entry in own if entry.seq != entry.number][:1]:
        what = "earlier lines are missing, moved or doubled"
        reading.faults.append(f"line {entry.number} is numbered {entry.seq}: {what}")
    by_seq = {entry.seq: entry for entry in own}
    last = max(by_seq, default=0)
    reading.next_seq = last + 1
    reading.missing = last - len(by_seq)
    return [by_seq[seq] for seq in sorted(by_seq)]


class Journal:
    """Writer that appends to one journal file. The caller holds the session's lock, so only one process writes.

    Raises `SessionError` where the disk fails, and `InputError` where the file is a link.
    """

    def __init__(self, path: Path, session: str = "") -> None:
        self.path = path
        self._session = session
        try:
            created = not check_file(path)
            self._seq = 1 if created else _whole_lines(path)
            self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            self._size = os.fstat(self._fd).st_size
            if created:
                fsync_folder(path.parent)
        except OSError as error:
            raise disk_error(path, "cannot open", error) from error

    def append(self, event: Event) -> None:
        """Write one event and wait until it is on disk. Raises `SessionError` where that fails."""
        data = encode_line(event, self._seq, self._session)
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


def _whole_lines(path: Path) -> int:
    """Make the journal end with a whole line, and return the number of the next one.

    A half-written line is cut off: nothing has happened yet that depends on it.
    """
    data = read_journal(path)
    reading = read(data)
    with path.open("r+b", buffering=0) as file:
        if reading.torn:
            file.truncate(len(data) - len(reading.torn))
        elif not data.endswith(b"\n"):  # only the newline was cut off
            file.seek(len(data))
            file.write(b"\n")
        os.fsync(file.fileno())
    return reading.next_seq
