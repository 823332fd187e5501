"""Merging: the steps of a session into one file when it closes, and several recordings into one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from sessions.disk import check_room, fsync_folder, publish, set_aside
from sessions.errors import InputError, SessionDamaged, disk_error
from sessions.journal.codec import Line
from sessions.journal.journal import Replay
from sessions.names import SESSION_ID, SNAPSHOT_NAMES
from sessions.progress import Progress, counted, unseen
from sessions.reader import Recording
from sessions.recording import container
from sessions.recording.container import Record
from sessions.recording.mcap_file import HEADER_METADATA, count_messages, new_mcap, read_note
from sessions.recording.schemas import Header, Quality, Stroke, Topic

REPAIRS_NOTE = "brushloop.repairs"
"""Note in a merged file whose session was repaired: what was rewritten, what is missing, and what was lost."""
PARTS_NOTE = "brushloop.parts"
"""Note in a file merged from recordings: file, SHA-256, header and own notes of each, and how it was renumbered."""
JOINED = ("software", "robot_firmware", "camera", "origin", "licence")
MAY_DIFFER = {"session_id", "protocol", *JOINED}
"""Header fields that may differ between parts; all others describe the setup and must agree."""
MUST_AGREE = ("rig.effective.json", "rig.toml")
"""The first of these that is attached must be the same in all parts: another camera pose means another scale."""


@dataclass(frozen=True, slots=True)
class _Part:
    recording: Recording
    prefix: str
    """Prefix added to the names of its strokes."""
    offset: int
    """Added to the numbers of its stills."""


def merge_session(folder: Path, state: Replay, header: Header, tag: str = "superseded") -> Path:
    """Merge the finished steps of a session into its one MCAP file, in the order of the journal.

    The file includes the configuration and a note of any repairs, so that it can be shared alone. It gets its name
    once it was read back with correct CRCs and the journal's counts. A file of that name, left by an interrupted close,
    is kept beside it under `tag`. Raises `SessionDamaged` naming the step that cannot be read, or the wrong counts.
    """
    final = folder / f"{folder.name}.mcap"
    if final.exists():
        set_aside(final, tag)
    part = final.with_name(final.name + ".part")
    expected = state.counts()
    try:
        part.unlink(missing_ok=True)  # only a copy of steps that still exist
        notes = {REPAIRS_NOTE: {"repairs": list(state.repairs)}} if state.repairs else {}
        snapshots = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
        attachments = {path.name: path.read_bytes() for path in snapshots}
        with new_mcap(part, header, notes, attachments) as copy:
            for line in state.segments:
                copy.add_file(folder / str(line["file"]))
        counts = count_messages(part)
        if counts != expected:
            raise SessionDamaged(part, f"holds {counts}, but the journal says {expected}")
        part.rename(final)
        fsync_folder(final.parent)
    except OSError as error:
        raise disk_error(part, "cannot write", error) from error
    return final


def merge_recordings(sources: list[Path], out: Path, progress: Progress = unseen) -> Path:
    """Merge session folders or MCAP files into `out` (a new .mcap file), read it back, and return it.

    It holds every message of every part, in the order of the parts; strokes are named `<session>/<stroke>` if the
    parts come from several sessions, and stills are renumbered so that no number appears twice.

    Raises `InputError` for parts of different setups, for a stroke that appears twice, or where `out` exists;
    `SessionDamaged` naming a part that cannot be read. No unfinished file is left.
    """
    if out.suffix != ".mcap" or not SESSION_ID.fullmatch(out.stem):
        raise InputError(out, "give the new file a name of letters, digits, '.', '_' and '-' that ends in .mcap")
    if out.exists():
        raise InputError(out, "exists already; recordings are never overwritten")
    if len(sources) < 2:
        raise InputError(out, "needs at least two recordings to merge")
    recordings = [Recording(path) for path in sources]
    header = _one_header(recordings, out.stem)
    attachments = _attachments(recordings)
    parts = _parts(recordings)
    check_room(out.parent, sum(recording.path.stat().st_size for recording in recordings))
    part = out.with_name(f".{out.name}.partial")
    try:
        part.unlink(missing_ok=True)  # left by a killed merge: only a copy
        notes = {PARTS_NOTE: {"parts": [_provenance(one) for one in parts]}}
        with new_mcap(part, header, notes, attachments) as copy:
            for one in counted(parts, "recordings merged", len(parts), progress):
                for record in _renumbered(one):
                    copy.add(*record)
        if count_messages(part) != dict(copy.counts):
            raise SessionDamaged(part, f"does not read back as {dict(copy.counts)}")
        publish(part, out)
        fsync_folder(out.parent)
    except FileExistsError:
        raise InputError(out, "exists already; recordings are never overwritten") from None
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    finally:
        part.unlink(missing_ok=True)
    return out


def _one_header(recordings: list[Recording], session_id: str) -> Header:
    first = recordings[0]
    for other in recordings[1:]:
        for name in Header.model_fields.keys() - MAY_DIFFER:
            one, two = getattr(first.header, name), getattr(other.header, name)
            if one != two:
                raise InputError(
                    other.path,
                    f"has {name} = {two!r}, but {first.path.name} has {one!r}: "
                    "one file holds one brush, ink, paper and rig",
                )
    joined = {
        name: "; ".join(dict.fromkeys(str(getattr(r.header, name)) for r in recordings if getattr(r.header, name)))
        for name in JOINED
    }
    protocols = {recording.header.protocol for recording in recordings}
    one_protocol = protocols.pop() if len(protocols) == 1 else f"{len(recordings)} recordings merged"
    return first.header.model_copy(update={**joined, "session_id": session_id, "protocol": one_protocol})


def _attachments(recordings: list[Recording]) -> dict[str, bytes]:
    """Configuration that all parts share, and each part's own protocol under the name of its session."""
    carried = [{a.name: a.data for a in container.attachments(recording.path)} for recording in recordings]
    first = next((files for files in carried if files), carried[0])  # the file of a single step has none
    for recording, other in zip(recordings, carried, strict=True):
        name = next((name for name in MUST_AGREE if name in first or name in other), None)
        if other and name is not None and first.get(name) != other.get(name):
            raise InputError(recording.path, f"was recorded with another {name} than the parts before it")
    joined = dict(first)
    for recording, other in zip(recordings, carried, strict=True):
        for name, data in other.items():
            if name not in SNAPSHOT_NAMES or first.get(name) != data:
                joined.setdefault(f"{recording.header.session_id}/{name}", data)
    return joined


def _parts(recordings: list[Recording]) -> list[_Part]:
    several = len({recording.header.session_id for recording in recordings}) > 1
    parts: list[_Part] = []
    digests: dict[str, Path] = {}
    strokes: dict[Path, set[int]] = {}
    """Hashes of what the strokes of each are called, and in which session: the names would take more memory."""
    offset = 0
    for recording in recordings:
        session, merged = recording.header.session_id, _merged(recording)
        for digest in (recording.sha256, *(part.sha256 for part in merged)):
            if digest in digests:
                raise InputError(recording.path, f"is, or holds, the same recording as {digests[digest]}")
            digests[digest] = recording.path
        mine = strokes[recording.path] = set[int]()
        for stroke in recording.stroke_records():
            origin = whose, name = _origin(merged, session, stroke.stroke_id)
            if (path := next((path for path, known in strokes.items() if hash(origin) in known), None)) is not None:
                raise InputError(recording.path, f"holds stroke {name} of {whose}, as does {path}")
            mine.add(hash(origin))
        parts.append(_Part(recording, f"{session}/" if several else "", offset))
        stills = container.messages(recording.path, [Topic.STILL])
        offset += 1 + max((message.sequence for _, _, message in stills), default=-1)
    return parts


@dataclass(frozen=True, slots=True)
class _Merged:
    """Recording that was merged into another one."""

    prefix: str
    session: str
    sha256: str


def _merged(recording: Recording) -> list[_Merged]:
    """Recordings that this one was merged from, recursively, outermost first."""
    try:
        notes = {record.name: record.metadata for record in container.metadata(recording.path)}
        return list(_parts_in(notes, ""))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise SessionDamaged(recording.path, "does not say what it was merged from") from None


def _parts_in(notes: dict[str, dict[str, str]], prefix: str) -> Iterator[_Merged]:
    for part in (read_note(notes[PARTS_NOTE]) or {})["parts"] if PARTS_NOTE in notes else ():
        inner = prefix + str(part["stroke_prefix"])
        yield _Merged(inner, str(part["header"]["session_id"]), str(part["sha256"]))
        yield from _parts_in(part["notes"], inner)


def _origin(merged: list[_Merged], session: str, stroke_id: str) -> tuple[str, str]:
    """Session and name under which a stroke was first recorded."""
    for part in reversed(merged):
        if stroke_id.startswith(part.prefix):
            return part.session, stroke_id.removeprefix(part.prefix)
    return session, stroke_id


def _provenance(part: _Part) -> Line:
    recording = part.recording
    return {
        "file": recording.path.name,
        "sha256": recording.sha256,
        "header": recording.header.model_dump(mode="json"),
        "stroke_prefix": part.prefix,
        "still_offset": part.offset,
        "notes": {m.name: m.metadata for m in container.metadata(recording.path) if m.name != HEADER_METADATA},
    }


def _renumbered(part: _Part) -> Iterator[Record]:
    """Messages of a part, with its strokes and stills named and numbered as in the merged file."""
    for schema, channel, message in container.messages(part.recording.path):
        try:
            if channel.topic == Topic.STILL:
                message.sequence += part.offset
            elif channel.topic == Topic.STROKE:
                stroke = Stroke.model_validate_json(message.data)
                moved = {"stroke_id": part.prefix + stroke.stroke_id, "still": stroke.still + part.offset}
                message.data = stroke.model_copy(update=moved).model_dump_json().encode()
            elif channel.topic == Topic.QUALITY:
                quality = Quality.model_validate_json(message.data)
                named = {"stroke_id": part.prefix + quality.stroke_id}
                message.data = quality.model_copy(update=named).model_dump_json().encode()
        except ValidationError:
            raise SessionDamaged(part.recording.path, f"a message on {channel.topic} does not fit its schema") from None
        yield schema, channel, message
