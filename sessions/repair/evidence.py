"""What a session's folder still tells, its journal and its files taken together; nothing is changed here.

Every segment carries the journal's `begin` line, and once finished its `done` line, so that lines which a journal
lost can be rebuilt word for word, and put back where they were.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sessions.errors import SessionDamaged, SessionError
from sessions.journal.codec import Line, encode_line
from sessions.journal.events import NONSENSE, serial_of
from sessions.journal.journal import JOURNAL_NAME, Account, DoneTwice, Replay, account, fold
from sessions.journal.lines import Fault, accounts_for, read_journal
from sessions.merge import count_messages
from sessions.names import check_file
from sessions.reader import parse_header
from sessions.recording.salvage import Scan, scan
from sessions.recording.schemas import Header, Recorded, Topic
from sessions.recording.writer import BEGIN_NOTE, DONE_NOTE, HEADER_METADATA, file_sha256
from sessions.repair.soundness import file_problems
from sessions.store import SEGMENT_NAME, SNAPSHOT_NAMES, closed_line, counts_of, done_line, open_line


@dataclass(slots=True)
class Evidence:
    """A journal as it is, and as it must have been."""

    folder: Path
    data: bytes | None
    """The journal's bytes; None where there is none."""
    lines: list[Line]
    """Lines that can be trusted, in order."""
    faults: list[Fault]
    """What is wrong with the journal, line by line: the list that every other command goes by as well."""
    torn: bytes
    unchained: int
    """How many lines are from before lines were chained."""
    rebuilt: list[Line] = field(default_factory=list[Line])
    """Lines that the journal lacks and that the files tell."""
    lost: int = 0
    """Lines that are damaged or missing, and that no file tells."""
    doubtful: list[str] = field(default_factory=list[str])
    """Files of attempts whose sheet and cell nobody knows."""
    strays: list[str] = field(default_factory=list[str])
    """Files that hold a step which the journal knows by another file."""
    state: Replay = field(default_factory=Replay)
    """All trusted and rebuilt lines, folded."""

    @property
    def all_lines(self) -> list[Line]:
        """The journal as it must have been: `open` first, what was rebuilt in the place where it was."""
        lines = list(self.lines)
        for line in self.rebuilt:
            lines.insert(_place(lines, line), line)
        return lines

    @property
    def intact(self) -> bool:
        """Whether the journal can stay as it is and only needs lines added."""
        return self.data is not None and not self.faults


def gather(folder: Path) -> Evidence:
    """Look at journal and files. Raises `SessionDamaged` where not even a header is left."""
    path = folder / JOURNAL_NAME
    data = read_journal(path) if check_file(path) else None
    told = account(data or b"")
    found = Evidence(folder, data, told.lines, told.faults, told.reading.torn, told.reading.unchained)
    _lost_between(found, told.twice)
    header = _from_files(found, told.state.done)
    if told.state.opened is None:
        header = header or _from_any_segment(folder) or _from_final(folder)
        if header is None:
            raise SessionDamaged(path, "has no `open` event, and no file is left that tells its header")
        found.rebuilt.insert(0, {"t_ns": 0, **open_line(header, _snapshots(folder))})
    _fold(found)
    _closed(found)
    found.lost = _lost(told, found.rebuilt)
    return found


def _fold(found: Evidence) -> None:
    for line in found.all_lines:
        try:
            fold(found.state, line)
        except DoneTwice:
            # Only a rebuilt line can be: the journal's own were folded one by one.
            found.rebuilt = [other for other in found.rebuilt if other is not line]


def _lost_between(found: Evidence, twice: list[Line]) -> None:
    """A step that is done twice, and whose first file is gone: the line that said so is what is missing."""
    for line in twice:
        held = (one for one in found.lines if one["event"] == "done" and one["key"] == line["key"])
        first = next(held, line)
        if first["file"] != line["file"] and not (found.folder / first["file"]).exists():
            why = "its file is gone, and the step was done again"
            lost = {"t_ns": line.get("t_ns", 0), "event": "lost", "key": line["key"], "file": first["file"]}
            found.rebuilt += [{**lost, "aside": "", "why": why}, line]


def _lost(told: Account, rebuilt: list[Line]) -> int:
    spoilt, others = list(told.spoilt), 0
    for line in rebuilt:
        body = encode_line(int(line["t_ns"]), _without_time(line))
        span = next((span for span in spoilt if accounts_for(span, body)), None)
        if span is None:
            others += 1
        else:
            spoilt.remove(span)
    return len(spoilt) + max(0, told.reading.gaps - others)


def _place(lines: list[Line], line: Line) -> int:
    """Where a rebuilt line belongs: `open` first, `closed` last, a step's before those of the next step."""
    if line["event"] == "open":
        return 0
    serial = serial_of(line)
    if line["event"] == "closed" or serial is None:
        return len(lines)
    for at, other in enumerate(lines):
        later = serial_of(other) if other["event"] in ("begin", "done") else None
        if other["event"] == "closed" or (later is not None and later > serial):
            return at
    return len(lines)


def _from_files(found: Evidence, live: dict[str, Line]) -> Header | None:
    """Rebuild `begin` and `done` lines from the notes in the segments; the header in one of them.

    `live` are the `done` lines that the journal has, and that no `lost` line takes back.
    """
    begun = {str(line.get("file")) for line in found.lines if line["event"] == "begin"}
    done = {str(line.get("file")) for line in [*found.lines, *found.rebuilt] if line["event"] == "done"}
    celled = {line["kind"] for line in found.lines if line["event"] == "begin" and line["cell"] is not None}
    uncelled = {line["kind"] for line in found.lines if line["event"] == "begin"} - celled
    doubted = {line.get("file") for line in found.lines if line["event"] == "doubt"}
    header: Header | None = None
    strays: list[str] = []
    for path, name, seen in _untold(found.folder, begun, done):
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
            # A digest that fits nothing has a damaged file looked at, and repaired, like any other.
            whole = path.name == name and not seen.damage and dict(seen.counts) == finish["counts"]
            found.rebuilt.append({**finish, "sha256": file_sha256(path) if whole else ""})
    begun |= {line["file"] for line in found.rebuilt if line["event"] == "begin"}
    found.strays = [name for name in strays if name.removesuffix(".part") not in begun]
    return header


def _untold(folder: Path, begun: set[str], done: set[str]) -> Iterator[tuple[Path, str, Scan]]:
    """Files of which the journal does not tell all, each with the name that it was given when it was written."""
    paths = [path for path in sorted(folder.glob("*.mcap*")) if SEGMENT_NAME.fullmatch(path.name)]
    told = [
        path for path in paths if path.name in begun & done or path.name.removesuffix(".part") in begun - {path.name}
    ]
    others = [path for path in paths if path not in told]
    exchanged = False
    while others:
        path = others.pop(0)
        seen = scan(path)
        line = _begin_line(seen.notes.get(BEGIN_NOTE, {}))
        name: str = path.name if line is None else line["file"]
        if name.removesuffix(".part") != path.name.removesuffix(".part") and not exchanged:
            exchanged = True
            others += told  # what it should hold may be in a file that has another's name
        yield path, name.removesuffix(".part"), seen


def _begin_line(note: dict[str, Any]) -> Line | None:
    try:
        line: Line = {"t_ns": note["t_ns"], **note["line"]}
        fold(Replay(), line)
    except NONSENSE:
        return None
    return line if line["event"] == "begin" else None


def _done_line(note: dict[str, Any], name: str) -> Line | None:
    """The `done` line that a file's note tells, without a digest; None where it makes no sense."""
    try:
        identity = {field: note[field] for field in ("key", "kind", "attempt")}
        line = done_line(identity, name, Recorded(note["counts"], "", 0), note["result"])
        line = {"t_ns": note.get("t_ns", 0), **line}
        fold(Replay(), line)
    except NONSENSE:
        return None
    return line


def _superseded(found: Evidence, finish: Line, live: dict[str, Line]) -> bool:
    """Whether the journal says that this attempt was cut, or lost, or that the step was done, or begun, again."""
    held = live.get(finish["key"])
    if held is not None and (held.get("attempt", 1) > finish["attempt"] or Topic.STROKE in held["counts"]):
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


def _from_any_segment(folder: Path) -> Header | None:
    for path in sorted(folder.glob("*.mcap*")):
        header = _header(scan(path).notes.get(BEGIN_NOTE, {})) if SEGMENT_NAME.fullmatch(path.name) else None
        if header is not None:
            return header
    return None


def _from_final(folder: Path) -> Header | None:
    final = folder / f"{folder.name}.mcap"
    if not final.is_file():
        return None
    metadata = scan(final).metadata.get(HEADER_METADATA)
    return parse_header(final, metadata) if metadata else None


def _snapshots(folder: Path) -> dict[str, str]:
    present = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
    return {path.name: path.read_text(encoding="utf-8", errors="replace") for path in present}


def _closed(found: Evidence) -> None:
    """A merged file that holds just what the journal counts was complete, though `closed` is missing."""
    final = found.folder / f"{found.folder.name}.mcap"
    if found.state.closed is not None or not final.is_file() or not found.state.segments:
        return
    try:
        complete = count_messages(final) == counts_of(found.state)
    except SessionError:
        return
    if complete:
        line: Line = {"t_ns": found.state.last_ns, **closed_line(final, counts_of(found.state))}
        found.rebuilt.append(line)
        fold(found.state, line)


def _without_time(line: Line) -> Line:
    return {name: value for name, value in line.items() if name != "t_ns"}


def final_is_sound(folder: Path, state: Replay) -> bool:
    """Whether the merged file is as it was closed, and reads back with every CRC."""
    final = folder / f"{folder.name}.mcap"
    if state.closed is None or not final.is_file():
        return False
    try:
        if "sha256" in state.closed and file_sha256(final) != state.closed["sha256"]:
            return False
        return count_messages(final) == state.closed.get("counts", counts_of(state)) and not file_problems(final)[1]
    except (SessionError, OSError):
        return False
