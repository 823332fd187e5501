"""Close a session: copy every finished segment into one MCAP, read it back, and only then give it its name."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from sessions.errors import SessionDamaged, disk_error, in_one_line
from sessions.journal.codec import Line
from sessions.journal.journal import fsync_folder
from sessions.recording.container import messages
from sessions.recording.schemas import Header, Topic
from sessions.recording.writer import CHUNK_BYTES, HEADER_METADATA, file_sha256, header_metadata, media_type, note

REPAIRS_NOTE = "brushloop.repairs"
"""Metadata of a merged file whose session was repaired: what was rewritten, with what missing, and what was lost."""


def merge(
    segments: list[Path],
    final: Path,
    header: Header,
    attachments: list[Path],
    expected: dict[str, int],
    repairs: Sequence[Line] = (),
) -> None:
    """Merge in the order given; the file gets its name once it reads back with CRCs checked and `expected` counts.

    `attachments` (the configuration) travel inside, so that the merged file is all that need be shared, and so does
    what repairs did. Raises `SessionDamaged` naming the segment that cannot be read, or the counts that do not agree.
    """
    part = final.with_name(final.name + ".part")
    try:
        part.unlink(missing_ok=True)  # only ever a copy of segments that are still there
        _write(segments, part, header, attachments, repairs)
        counts = count_messages(part)
        if counts != expected:
            raise SessionDamaged(part, f"holds {counts}, but the journal says {expected}")
        part.rename(final)
        fsync_folder(final.parent)
    except OSError as error:
        raise disk_error(part, "cannot write", error) from error


def count_messages(path: Path) -> dict[str, int]:
    """Messages by topic, every chunk's CRC checked. Raises `SessionDamaged`."""
    return dict(Counter(channel.topic for _schema, channel, _message in messages(path)))


def verify(path: Path, sha256: str) -> None:
    """Raise `SessionDamaged` unless the file is byte for byte what was recorded."""
    if not path.is_file():
        raise SessionDamaged(path, "is missing, though the journal says it was finished")
    try:
        digest = file_sha256(path)
    except OSError as error:
        raise SessionDamaged(path, f"cannot read: {in_one_line(error)}") from None
    if digest != sha256:
        raise SessionDamaged(path, "has changed since it was recorded (sha256 differs from the journal)")


def _write(segments: list[Path], part: Path, header: Header, attachments: list[Path], repairs: Sequence[Line]) -> None:
    with part.open("xb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library=header.software)
        writer.add_metadata(HEADER_METADATA, header_metadata(header))
        if repairs:
            writer.add_metadata(REPAIRS_NOTE, note({"repairs": list(repairs)}))
        copier = Copier(writer)
        for path in attachments:
            writer.add_attachment(0, 0, path.name, media_type(path.name), path.read_bytes())
        for segment in segments:
            for schema, channel, message in messages(segment):
                copier.add(schema, channel, message)
        writer.finish()
        file.flush()
        os.fsync(file.fileno())


class Copier:
    """Copies messages into one file, each channel registered once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[tuple[str, str], int] = {}

    def add(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """Write one message with its own times and sequence."""
        ident = (channel.topic, schema.name if schema else "")
        if ident not in self._channels:
            schema_id = 0
            if schema:
                schema_id = self._writer.register_schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            self._channels[ident] = self._writer.register_channel(
                topic=channel.topic, message_encoding=channel.message_encoding, schema_id=schema_id
            )
        self._writer.add_message(
            channel_id=self._channels[ident],
            log_time=message.log_time,
            publish_time=message.publish_time,
            sequence=message.sequence,
            data=message.data,
        )
        if channel.topic == Topic.STROKE:
            self._writer.flush()  # a chunk of its own: what damages it costs this one stroke
