"""What a session's folder still tells, its journal and its files taken together; nothing is changed here.

Every segment carries the journal's `begin` line, and once finished its `done` line, so that lines which a journal
lost can be rebuilt word for word.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sessions.errors import SessionDamaged, SessionError
from sessions.journal import JOURNAL_NAME, Replay, fold
from sessions.lines import Line, Recovered, accounts_for, encode_line, read_journal, recover_lines
from sessions.merge import count_messages
from sessions.reader import parse_header
from sessions.salvage import scan
from sessions.schemas import Header, Recorded
from sessions.store import SEGMENT_NAME, SNAPSHOT_NAMES, closed_line, counts_of, done_line, open_line
from sessions.writer import BEGIN_NOTE, DONE_NOTE, HEADER_METADATA, file_sha256

NONSENSE = (KeyError, TypeError, ValueError, OverflowError, AttributeError)
"""What folding a line may raise where the line makes no sense."""


@dataclass(slots=True)
class Evidence:
    """A journal as it is, and as it must have been."""

    folder: Path
    data: bytes | None
    """The journal's bytes; None where there is none."""
    journal: Recovered
    lines: list[Line] = field(default_factory=list[Line])
    """Intact lines, in order."""
    rebuilt: list[Line] = field(default_factory=list[Line])
    """Lines that the journal lacks and that the files tell."""
    spoilt: list[bytes] = field(default_factory=list[bytes])
    """Damaged lines that no file tells."""
    doubtful: list[str] = field(default_factory=list[str])
    """Files of attempts whose sheet and cell nobody knows."""
    state: Replay = field(default_factory=Replay)
    """All intact and rebuilt lines, folded."""

    @property
    def all_lines(self) -> list[Line]:
        """The journal as it must have been: `open` first, what was rebuilt last."""
        lines = [*self.lines, *self.rebuilt]
        return sorted(lines, key=lambda line: line["event"] != "open")

    @property
    def intact(self) -> bool:
        """Whether the journal can stay as it is and only needs lines added."""
        return self.data is not None and self.journal.whole


def gather(folder: Path) -> Evidence:
    """Look at journal and files. Raises `SessionDamaged` where not even a header is left."""
    path = folder / JOURNAL_NAME
    data = read_journal(path) if path.is_file() else None
    found = Evidence(folder, data, recover_lines(data or b""))
    scratch = Replay()
    for line in found.journal.lines:
        try:
            fold(scratch, line)
        except NONSENSE:
            found.spoilt.append(encode_line(0, line))  # only a journal without CRCs can hold such a line
        else:
            found.lines.append(line)
    found.spoilt += found.journal.spoilt
    header = _from_files(found)
    if scratch.opened is None:
        header = header or _from_any_segment(folder) or _from_final(folder)
        if header is None:
            raise SessionDamaged(path, "has no `open` event, and no file is left that tells its header")
        found.rebuilt.append({"t_ns": 0, **open_line(header, _snapshots(folder))})
    for line in found.all_lines:
        fold(found.state, line)
    _closed(found)
    for line in found.rebuilt:
        for span in found.spoilt:
            if accounts_for(span, encode_line(int(line["t_ns"]), _without_time(line))):
                found.spoilt.remove(span)
                break
    return found


def _from_files(found: Evidence) -> Header | None:
    """Rebuild `begin` and `done` lines from the notes in the segments; the header in one of them."""
    begun = {str(line.get("file")) for line in found.lines if line["event"] == "begin"}
    done = {str(line.get("file")) for line in found.lines if line["event"] == "done"}
    celled = {line["kind"] for line in found.lines if line["event"] == "begin" and line["cell"] is not None}
    uncelled = {line["kind"] for line in found.lines if line["event"] == "begin"} - celled
    doubted = {line["file"] for line in found.lines if line["event"] == "doubt"}
    header: Header | None = None
    for path in sorted(found.folder.glob("*.mcap*")):
        match = SEGMENT_NAME.fullmatch(path.name)
        if match is None:
            continue
        name, finished = path.name.removesuffix(".part"), match[4] is None
        if name in begun and (name in done or not finished):
            continue
        seen = scan(path)
        note = seen.notes.get(BEGIN_NOTE, {})
        header = header or _header(note)
        if name not in begun:
            line = _begin_line(note, name)
            if line is None:
                if match[2] not in uncelled and name not in doubted:
                    found.doubtful.append(name)
                continue
            found.rebuilt.append(line)
        finish = seen.notes.get(DONE_NOTE)
        if finished and name not in done and finish is not None and not _superseded(found, finish):
            # A digest that fits nothing has a damaged file looked at, and repaired, like any other.
            whole = not seen.damage and dict(seen.counts) == finish.get("counts")
            digest = file_sha256(path) if whole else ""
            found.rebuilt.append(_done(finish, name, digest))
    return header


def _begin_line(note: dict[str, Any], name: str) -> Line | None:
    try:
        line: Line = {"t_ns": note["t_ns"], **note["line"]}
        if line["file"] != name:
            return None
        fold(Replay(), line)
    except NONSENSE:
        return None
    return line


def _done(note: dict[str, Any], name: str, digest: str) -> Line:
    identity = {field: note[field] for field in ("key", "kind", "attempt")}
    recorded = Recorded(note["counts"], digest, 0)
    return {"t_ns": note.get("t_ns", 0), **done_line(identity, name, recorded, note["result"])}


def _superseded(found: Evidence, finish: dict[str, Any]) -> bool:
    """Whether the journal says that this attempt was cut, or that the step was done, or begun, again."""
    key, attempt = finish.get("key"), finish.get("attempt", 0)
    for line in [*found.lines, *found.rebuilt]:
        if line.get("key") == key:
            match line["event"]:
                case "done" | "lost":
                    return True
                case "begin" if int(line["attempt"]) > attempt:
                    return True
                case "void" if line.get("attempt") == attempt:
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
        return count_messages(final) == state.closed.get("counts", counts_of(state))
    except (SessionError, OSError):
        return False
