"""Writing again what could be read of a damaged file: beside it, read back, and only then in its place."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from google.protobuf.message import DecodeError
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from pydantic import ValidationError

from sessions.disk import set_aside
from sessions.errors import disk_error
from sessions.journal import fsync_folder
from sessions.lines import Line
from sessions.merge import Copier, count_messages
from sessions.messages import decode_still
from sessions.salvage import Scan, salvaged
from sessions.schemas import Header, Stroke, Topic
from sessions.writer import CHUNK_BYTES, HEADER_METADATA, header_metadata, media_type, note

Messages = Iterable[tuple[Schema | None, Channel, Message]]


def replace_damaged(
    path: Path, header: Header, notes: dict[str, Line], attachments: dict[str, bytes], messages: Messages
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


def with_their_stills(found: Scan) -> tuple[Iterator[tuple[Schema | None, Channel, Message]], list[str]]:
    """The messages of a salvaged recording without strokes whose still is lost; and the names of those strokes."""
    there = {m.sequence for _, channel, m in salvaged(found) if channel.topic == Topic.STILL and _shows(m)}
    lost: list[str] = []
    for _schema, channel, message in salvaged(found):
        if channel.topic == Topic.STROKE:
            stroke = _stroke(message)
            if stroke is not None and stroke.still not in there:
                lost.append(stroke.stroke_id)
    gone = set(lost)

    def kept() -> Iterator[tuple[Schema | None, Channel, Message]]:
        for schema, channel, message in salvaged(found):
            stroke = _stroke(message) if channel.topic == Topic.STROKE else None
            if stroke is None or stroke.stroke_id not in gone:
                yield schema, channel, message

    return kept(), lost


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
