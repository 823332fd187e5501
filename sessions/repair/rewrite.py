"""Writing again what could be read of a damaged file: beside it, read back, and only then in its place."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError
from mcap.records import Message
from mcap.writer import CompressionType, Writer
from pydantic import ValidationError

from sessions.disk import set_aside
from sessions.errors import disk_error
from sessions.journal.codec import Line
from sessions.journal.journal import fsync_folder
from sessions.merge import Copier, count_messages
from sessions.recording.messages import decode_still
from sessions.recording.salvage import Record, Scan, glimpsed, salvaged
from sessions.recording.schemas import Header, Stroke, Topic
from sessions.recording.writer import CHUNK_BYTES, HEADER_METADATA, header_metadata, media_type, note


def replace_damaged(
    path: Path, header: Header, notes: dict[str, Line], attachments: dict[str, bytes], messages: Iterable[Record]
) -> tuple[str, dict[str, int]]:
    """Write a file with these contents in place of `path`, which is kept beside it.

    Returns the name under which the damaged file is kept (empty where there was none) and the messages by topic, as
    read back. Raises `SessionError`; the damaged file then still has its name.
    """
    fresh = path.with_name(path.name + ".repair")
    try:
        fresh.unlink(missing_ok=True)  # left by a repair that was killed: a copy
        with fresh.open("xb") as file:
            writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            writer.start(profile="", library=header.software)
            writer.add_metadata(HEADER_METADATA, header_metadata(header))
            for name, values in notes.items():
                writer.add_metadata(name, note(values))
            for name, data in attachments.items():
                writer.add_attachment(0, 0, name, media_type(name), data)
            copier = Copier(writer)
            for schema, channel, message in messages:
                copier.add(schema, channel, message)
            writer.finish()
            file.flush()
            os.fsync(file.fileno())
        counts = count_messages(fresh)
        kept = set_aside(path, "damaged").name if path.exists() else ""
        fresh.replace(path)
        fsync_folder(path.parent)
    except OSError as error:
        raise disk_error(path, "cannot write its repaired copy", error) from error
    return kept, counts


@dataclass(frozen=True, slots=True)
class Strokes:
    """What can be given back of a recording that stands alone: strokes with their photographs, each once."""

    found: Scan
    kept: tuple[str, ...]
    photograph_lost: tuple[str, ...]
    """Strokes whose still cannot be read."""
    numbers_lost: tuple[int, ...]
    """Which strokes of the recording, counted from 1, cannot be read themselves."""
    names_lost: tuple[str, ...]
    """What their chunks still show of their names, as far as that can be read."""
    total: int
    """Strokes that the recording held, as far as anything tells."""

    def messages(self) -> Iterator[Record]:
        """Everything that can be read, less strokes without their photograph and those that are there already."""
        gone, seen = set(self.photograph_lost), set[str]()
        for schema, channel, message in salvaged(self.found):
            stroke = _stroke(message) if channel.topic == Topic.STROKE else None
            if stroke is not None:
                if stroke.stroke_id in gone | seen:
                    continue
                seen.add(stroke.stroke_id)
            yield schema, channel, message


def with_their_stills(found: Scan) -> Strokes:
    """Which strokes of a salvaged recording are there with their stills, and which are lost."""
    there = {m.sequence for _, channel, m in salvaged(found) if channel.topic == Topic.STILL and _shows(m)}
    names: dict[str, bool] = {}
    for _schema, channel, message in salvaged(found):
        stroke = _stroke(message) if channel.topic == Topic.STROKE else None
        if stroke is not None:
            names[stroke.stroke_id] = names.get(stroke.stroke_id, False) or stroke.still in there
    missing: list[int] = []
    number = 0
    for part in found.parts:
        count = (part.counts or Counter[str]())[Topic.STROKE]
        missing += [] if part.sound else range(number + 1, number + count + 1)
        number += count
    kept = tuple(name for name, whole in names.items() if whole)
    lost = tuple(name for name, whole in names.items() if not whole)
    return Strokes(found, kept, lost, tuple(missing), tuple(glimpsed(found)) if missing else (), number)


def lost_words(strokes: Strokes, before: Counter[str], now: dict[str, int]) -> list[str]:
    """What was lost: each stroke by its name, or by its number where its name is lost with it, then the rest."""
    lost = [f"stroke {name}: its photograph is lost" for name in strokes.photograph_lost]
    named = len(strokes.names_lost) == len(strokes.numbers_lost)
    for at, number in enumerate(strokes.numbers_lost):
        name = f"{strokes.names_lost[at]}, " if named else ""
        lost.append(f"stroke {name}number {number} of {strokes.total} in the recording: it cannot be read")
    told = len(strokes.numbers_lost) + len(strokes.photograph_lost)
    unknown = before[Topic.STROKE] - now.get(Topic.STROKE, 0) - told
    if unknown > 0:
        lost.append(f"{unknown} strokes of which nothing is left that names them")
    gone = {topic: count - now.get(topic, 0) for topic, count in before.items() if topic != Topic.STROKE}
    return lost + [f"messages on {topic}: {count}" for topic, count in gone.items() if count > 0]


def _shows(message: Message) -> bool:
    try:
        return bool(decode_still(message.data))
    except DecodeError:
        return False


def _stroke(message: Message) -> Stroke | None:
    try:
        return Stroke.model_validate_json(message.data)
    except ValidationError:
        return None
