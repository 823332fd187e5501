"""Find out what a damaged session contained, from its journal and its files together; changes nothing.

The file of every step holds a copy of the journal's `begin` line and, once finished, of its `done` line. Lost lines
of the journal are rebuilt from these word for word, and put back in their place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from brushloop.sessions.disk import (
    MAX_SNAPSHOT_BYTES,
    SEGMENT_NAME,
    SNAPSHOT_NAMES,
    check_file,
    file_sha256,
    read_bounded,
)
from brushloop.sessions.errors import SessionDamaged, SessionError
from brushloop.sessions.events import Begin, Done, Event, Open, line_of, parse_event, serial_of
from brushloop.sessions.journal import JOURNAL_NAME, Fault, Line, read_journal
from brushloop.sessions.mcap_file import McapFile, scan
from brushloop.sessions.recording import count_messages, parse_header
from brushloop.sessions.records import BEGIN_NOTE, DONE_NOTE, HEADER_METADATA, Header, Topic
from brushloop.sessions.run_state import Account, DoneTwice, RunState, account
from brushloop.sessions.show import step_words
from brushloop.sessions.store import closed

NONSENSE = (KeyError, TypeError, ValueError)
"""Exceptions that a malformed note may cause."""


@dataclass(slots=True)
class Evidence:
    """Journal of a session as it is, and as it must have been."""

    folder: Path
    data: bytes | None
    """The journal's bytes; None if the file is missing."""
    lines: list[Line]
    """Lines that can be trusted, in order."""
    faults: list[Fault]
    """Problems of the journal, line by line; every command uses this list."""
    torn: bytes
    rebuilt: list[Line] = field(default_factory=list[Line])
    """Lines missing from the journal and found in the files."""
    lost: int = 0
    """Number of damaged or missing lines of which no file holds a copy."""
    doubtful: list[str] = field(default_factory=list[str])
    """Files of attempts whose sheet and patch are unknown."""
    strays: list[str] = field(default_factory=list[str])
    """Files that hold a step which the journal lists under another file."""
    session: str = ""
    """Id of the session: neither lines nor files of another one are evidence of anything."""
    foreign: dict[str, str] = field(default_factory=dict[str, str])
    """Files of other sessions that the journal does not list, and the ids of those sessions."""
    state: RunState = field(default_factory=RunState)
    """State after all trusted and rebuilt lines."""

    @property
    def all_lines(self) -> list[Line]:
        """Journal as it must have been, with the rebuilt lines in their places."""
        lines = list(self.lines)
        for line in self.rebuilt:
            lines.insert(_place(lines, line), line)
        return lines

    @property
    def intact(self) -> bool:
        """Whether the journal can be kept; lines may still be added."""
        return self.data is not None and not self.faults


def gather(folder: Path) -> Evidence:
    """Read the journal and the files. Raises `SessionDamaged` if not even a header is left."""
    path = folder / JOURNAL_NAME
    too_large: list[Fault] = []
    try:
        data = read_journal(path) if check_file(path) else None
    except SessionDamaged as error:
        data, too_large = b"", [Fault(1, error.what)]
    journal = account(data or b"")
    session = _session(folder, journal.state)
    if session and session != _named_in(journal.state):
        journal = account(data or b"", session)
    found = Evidence(folder, data, journal.lines, too_large + journal.faults, journal.reading.torn)
    found.session = session
    _lost_between(found, journal.twice)
    header = _from_files(found, journal.state.done)
    if journal.state.opened is None:
        header = header or _from_any_segment(found) or _from_final(found)
        if header is None:
            raise SessionDamaged(path, "has no `open` event, and no file holds its header")
        found.rebuilt.insert(0, full_line(Open(t_ns=0, header=header, snapshots=_snapshots(folder))))
    _fold(found)
    _closed(found)
    found.lost = _lost(journal, found.all_lines)
    return found


def full_line(event: Event) -> Line:
    """The line of an event, with its time."""
    return {"t_ns": event.t_ns, **line_of(event)}


def line_words(line: Line) -> str:
    """Name of the step of a line, for people."""
    event = parse_event(line)
    return step_words(event) if isinstance(event, Begin | Done) else "the session"


def _named_in(state: RunState) -> str:
    return "" if state.opened is None else state.opened.header.session_id


def _session(folder: Path, state: RunState) -> str:
    """Id of the session in a folder: its name, unless neither journal nor files say it; then the id of most files."""
    named = _named_in(state)
    if named == folder.name:
        return named
    finals = {f"{folder.name}.mcap", f"{folder.resolve().name}.mcap"}
    paths = [path for path in folder.glob("*.mcap*") if SEGMENT_NAME.fullmatch(path.name) or path.name in finals]
    files = Counter(session for path in paths if (session := McapFile(path).session))
    if folder.name in files or not files:
        return folder.name if files else named
    return named if files[named] == max(files.values()) else files.most_common(1)[0][0]


def _fold(found: Evidence) -> None:
    for line in found.all_lines:
        try:
            found.state.apply(parse_event(line))
        except DoneTwice:
            # Only a rebuilt line can raise this: the journal's own lines were applied before.
            found.rebuilt = [other for other in found.rebuilt if other is not line]


def _lost_between(found: Evidence, twice: list[Line]) -> None:
    """Rebuild the `lost` line of a step that is done twice and whose first file is gone."""
    for line in twice:
        held = (one for one in found.lines if one["event"] == "done" and one["key"] == line["key"])
        first = next(held, line)
        if first["file"] != line["file"] and not (found.folder / first["file"]).exists():
            why = "its file is gone, and the step was done again"
            lost = {"t_ns": line.get("t_ns", 0), "event": "lost", "key": line["key"], "file": first["file"]}
            found.rebuilt += [{**lost, "aside": "", "why": why}, line]


def _lost(journal: Account, lines: list[Line]) -> int:
    """Number of missing or damaged lines, less those that were rebuilt in the same place."""
    numbers = {id(entry.line): entry.seq for entry in journal.reading.entries}
    lost = rebuilt = last = 0
    for line in lines:
        seq = numbers.get(id(line))
        if seq is None:
            rebuilt += 1
        else:
            lost, rebuilt, last = lost + max(0, seq - last - 1 - rebuilt), 0, seq
    end = max((entry.number for entry in journal.reading.entries), default=0)
    return lost + max(0, sum(number > end for number in journal.reading.damaged) - rebuilt)


def _place(lines: list[Line], line: Line) -> int:
    """Index for a rebuilt line: `open` first, `closed` last, the lines of a step before those of the next."""
    if line["event"] == "open":
        return 0
    serial = serial_of(str(line.get("file", "")))
    if line["event"] == "closed" or serial is None:
        return len(lines)
    for at, other in enumerate(lines):
        later = serial_of(str(other["file"])) if other["event"] in ("begin", "done") else None
        if other["event"] == "closed" or (later is not None and later > serial):
            return at
    return len(lines)


def _from_files(found: Evidence, live: dict[str, Done]) -> Header | None:
    """Rebuild `begin` and `done` lines from the notes in the files of steps; return the header from one of them.

    `live` are the journal's `done` lines that no `lost` line revokes.
    """
    begun = {str(line.get("file")) for line in found.lines if line["event"] == "begin"}
    done = {str(line.get("file")) for line in [*found.lines, *found.rebuilt] if line["event"] == "done"}
    celled = {line["kind"] for line in found.lines if line["event"] == "begin" and line.get("patch") is not None}
    uncelled = {line["kind"] for line in found.lines if line["event"] == "begin"} - celled
    doubted = {line.get("file") for line in found.lines if line["event"] == "doubt"}
    header: Header | None = None
    strays: list[str] = []
    for path, name, seen in _uncovered(found.folder, begun, done):
        if seen.session not in ("", found.session):
            found.foreign[path.name] = seen.session
            continue
        if path.name.removesuffix(".part") != name:
            strays.append(path.name)
        if name in begun and (name in done or path.name.endswith(".part")):
            continue
        finished = not path.name.endswith(".part")
        note = seen.notes.get(BEGIN_NOTE, {})
        header = header or _header(note)
        if name not in begun:
            line = _begin_line(note)
            if line is None:
                match = SEGMENT_NAME.fullmatch(path.name)
                if match is not None and match[2] not in uncelled and path.name not in doubted:
                    found.doubtful.append(path.name)
                continue
            found.rebuilt.append(line)
        finish = _done_line(seen.notes.get(DONE_NOTE, {}), name)
        if finished and name not in done and finish is not None and not _superseded(found, finish, live):
            # An empty digest matches no file, so a damaged file is found and repaired like any other.
            whole = path.name == name and not seen.damage and dict(seen.counts) == finish["counts"]
            found.rebuilt.append({**finish, "sha256": file_sha256(path) if whole else ""})
    begun |= {line["file"] for line in found.rebuilt if line["event"] == "begin"}
    found.strays = [name for name in strays if name.removesuffix(".part") not in begun]
    return header


def _uncovered(folder: Path, begun: set[str], done: set[str]) -> Iterator[tuple[Path, str, McapFile]]:
    """Files not fully covered by the journal, each with the name under which it was written."""
    paths = [path for path in sorted(folder.glob("*.mcap*")) if SEGMENT_NAME.fullmatch(path.name)]
    covered = [
        path for path in paths if path.name in begun & done or path.name.removesuffix(".part") in begun - {path.name}
    ]
    others = [path for path in paths if path not in covered]
    exchanged = False
    while others:
        path = others.pop(0)
        seen = scan(path)
        line = _begin_line(seen.notes.get(BEGIN_NOTE, {}))
        name: str = path.name if line is None else line["file"]
        if name.removesuffix(".part") != path.name.removesuffix(".part") and not exchanged:
            exchanged = True
            others += covered  # files were exchanged: a covered one may hold another step
        yield path, name.removesuffix(".part"), seen


def _begin_line(note: dict[str, Any]) -> Line | None:
    try:
        line: Line = {"t_ns": note["t_ns"], **note["line"]}
        parse_event(line)
    except NONSENSE:
        return None
    return line if line["event"] == "begin" else None


def _done_line(note: dict[str, Any], name: str) -> Line | None:
    """Make the `done` line from a file's note, without a digest; None where the note makes no sense."""
    try:
        line: Line = {"event": "done", **note, "file": name, "sha256": ""}
        parse_event(line)
    except NONSENSE:
        return None
    return line


def _superseded(found: Evidence, finish: Line, live: dict[str, Done]) -> bool:
    """Whether the attempt was cut or lost, or its step begun or done again, according to the journal."""
    held = live.get(finish["key"])
    if held is not None and (held.attempt > finish["attempt"] or Topic.STROKE in held.counts):
        return True
    for line in [*found.lines, *found.rebuilt]:
        if line.get("key") != finish["key"]:
            continue
        match line["event"]:
            case "lost" if line["file"] == finish["file"]:
                return True
            case "begin" if line["attempt"] > finish["attempt"]:
                return True
            case "void" if line["attempt"] == finish["attempt"]:
                return True
            case _:
                pass
    return False


def _header(note: dict[str, Any]) -> Header | None:
    try:
        return Header.model_validate(note["header"])
    except (KeyError, ValidationError):
        return None


def _from_any_segment(found: Evidence) -> Header | None:
    for path in sorted(found.folder.glob("*.mcap*")):
        header = _header(McapFile(path).notes.get(BEGIN_NOTE, {})) if SEGMENT_NAME.fullmatch(path.name) else None
        if header is not None and header.session_id == found.session:
            return header
    return None


def _from_final(found: Evidence) -> Header | None:
    final = found.folder / f"{found.folder.name}.mcap"
    if not final.is_file():
        return None
    metadata = McapFile(final).metadata.get(HEADER_METADATA)
    return parse_header(final, metadata) if metadata else None


def _snapshots(folder: Path) -> dict[str, str]:
    present = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
    return {path.name: read_bounded(path, MAX_SNAPSHOT_BYTES).decode("utf-8", "replace") for path in present}


def _closed(found: Evidence) -> None:
    """Rebuild the `closed` line if the merged file is sound and holds all messages that the journal counts, or more.

    It holds more where the files of steps are lost with their lines: it is then the only copy.
    """
    final = found.folder / f"{found.folder.name}.mcap"
    if found.state.closed is not None or not final.is_file():
        return
    try:
        counts = count_messages(final)
    except SessionError:
        return
    if counts and Counter(counts) >= Counter(found.state.counts()) and McapFile(final).session in ("", found.session):
        event = closed(final, counts, found.state.last_ns)
        found.rebuilt.append(full_line(event))
        found.state.apply(event)
