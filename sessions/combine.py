"""Several recordings become one file, which reads like any other: the strokes of one setup, collected in parts.

What a reader may rely on afterwards: every message of every part, in the order of the parts; strokes named
`<session>/<stroke>` where the parts are of several sessions; stills renumbered so that each number is there once; and
in the metadata, for each part, its file, SHA-256, session, header and how its numbers were moved.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from pydantic import ValidationError

from sessions.disk import check_room, publish
from sessions.errors import InputError, SessionDamaged, disk_error
from sessions.journal.codec import Line
from sessions.journal.journal import fsync_folder
from sessions.merge import Copier, count_messages
from sessions.reader import Recording
from sessions.recording import container
from sessions.recording.schemas import Header, Quality, Stroke, Topic
from sessions.recording.writer import CHUNK_BYTES, HEADER_METADATA, header_metadata, media_type, note, read_note
from sessions.store import SESSION_ID, SNAPSHOT_NAMES

PARTS_NOTE = "brushloop.parts"
JOINED = ("software", "robot_firmware", "camera", "origin", "licence")
MAY_DIFFER = {"session_id", "protocol", *JOINED}
"""Header fields that may differ between parts. All others make one setup, which is what a session is."""
MUST_AGREE = ("rig.effective.json", "rig.toml")
"""The first of these that a part carries must be the same in all: another camera pose is another scale."""


@dataclass(frozen=True, slots=True)
class _Part:
    recording: Recording
    prefix: str
    """Put before the names of its strokes."""
    offset: int
    """Added to the numbers of its stills."""


def combine(sources: list[Path], out: Path) -> Path:
    """Write `out` (a new .mcap file) from session folders or MCAP files, read it back, and return it.

    Raises `InputError` where the parts are not of one setup, where a stroke is there twice, or where `out` exists;
    `SessionDamaged` naming a part that cannot be read. Nothing half-written is left.
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
        part.unlink(missing_ok=True)  # left by a merge that was killed: a copy
        expected = _write(parts, part, header, attachments)
        if count_messages(part) != dict(expected):
            raise SessionDamaged(part, f"does not read back as {dict(expected)}")
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
    """The configuration that all parts share, and each one's own protocol under its session's name."""
    carried = [{a.name: a.data for a in container.attachments(recording.path)} for recording in recordings]
    first = next((files for files in carried if files), carried[0])  # the file of a single step carries none
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
    strokes: dict[tuple[str, str], Path] = {}
    offset = 0
    for recording in recordings:
        session, merged = recording.header.session_id, _merged(recording)
        for digest in (recording.sha256, *(part.sha256 for part in merged)):
            if digest in digests:
                raise InputError(recording.path, f"is, or holds, the same recording as {digests[digest]}")
            digests[digest] = recording.path
        for stroke in recording.stroke_records():
            whose, name = _origin(merged, session, stroke.stroke_id)
            if (whose, name) in strokes:
                raise InputError(recording.path, f"holds stroke {name} of {whose}, as does {strokes[whose, name]}")
            strokes[whose, name] = recording.path
        parts.append(_Part(recording, f"{session}/" if several else "", offset))
        stills = container.messages(recording.path, [Topic.STILL])
        offset += 1 + max((message.sequence for _, _, message in stills), default=-1)
    return parts


@dataclass(frozen=True, slots=True)
class _Merged:
    """A recording that was merged into another one."""

    prefix: str
    session: str
    sha256: str


def _merged(recording: Recording) -> list[_Merged]:
    """What a recording says that it was merged from, and these in turn; the outermost first."""
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
    """The session and the name that a stroke was recorded under."""
    for part in reversed(merged):
        if stroke_id.startswith(part.prefix):
            return part.session, stroke_id.removeprefix(part.prefix)
    return session, stroke_id


def _write(parts: list[_Part], path: Path, header: Header, attachments: dict[str, bytes]) -> Counter[str]:
    written: Counter[str] = Counter()
    with path.open("xb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library=header.software)
        writer.add_metadata(HEADER_METADATA, header_metadata(header))
        writer.add_metadata(PARTS_NOTE, note({"parts": [_provenance(part) for part in parts]}))
        for name, data in attachments.items():
            writer.add_attachment(0, 0, name, media_type(name), data)
        copier = Copier(writer)
        for part in parts:
            for schema, channel, message in _moved(part):
                copier.add(schema, channel, message)
                written[channel.topic] += 1
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return written


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


def _moved(part: _Part) -> Iterator[tuple[Schema | None, Channel, Message]]:
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
