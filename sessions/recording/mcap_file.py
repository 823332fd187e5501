"""Write MCAP files: what comes before the messages (header, notes, attachments), and the messages themselves.

Metadata has no CRC in MCAP, so the header and each note include one.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import zlib
from collections import Counter
from collections.abc import Generator, Mapping
from pathlib import Path, PurePath
from typing import IO, Any, cast

from mcap.records import Channel, Message, Schema

from brushloop.sessions.disk import sync
from brushloop.sessions.errors import SessionDamaged, in_one_line
from brushloop.sessions.recording import container
from brushloop.sessions.recording.mcap_writer import McapWriter
from brushloop.sessions.recording.schemas import Header, Topic

HEADER_METADATA = "brushloop.header"
BEGIN_NOTE, DONE_NOTE = "brushloop.begin", "brushloop.done"
"""Notes of a step's file: the journal's lines about it, so that a lost journal can be rebuilt."""
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


def start_mcap(
    file: IO[bytes], header: Header, notes: Mapping[str, Mapping[str, Any]], attachments: Mapping[str, bytes]
) -> McapWriter:
    """Begin an MCAP file with everything that comes before its messages."""
    writer = McapWriter(file, header.software)
    writer.add_metadata(HEADER_METADATA, header_metadata(header))
    for name, values in notes.items():
        writer.add_metadata(name, note(values))
    for name, data in attachments.items():
        media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
        writer.add_attachment(name, media_type, data)
    return writer


class Copy:
    """A new file that takes messages of other files as they are: times, sequence numbers and data stay."""

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._numbers: dict[tuple[str, str], int] = {}

    def add(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """Add one message."""
        self._writer.add_message(
            channel_id=self._number(schema, channel),
            log_time=message.log_time,
            publish_time=message.publish_time,
            sequence=message.sequence,
            data=message.data,
        )
        if channel.topic == Topic.STROKE:
            self._writer.flush()  # ends the chunk, so that a damaged chunk costs one stroke

    def add_file(self, path: Path) -> None:
        """Add all messages of a file, chunk by chunk, every CRC checked. Raises `SessionDamaged`."""
        for contents, found in container.chunks(path):
            channels = {number: found.channels[number] for number in contents.index}
            numbers = {
                number: self._number(found.schemas[channel.schema_id] if channel.schema_id else None, channel)
                for number, channel in channels.items()
            }
            self._writer.add_contents(contents, numbers)
            if any(channel.topic == Topic.STROKE for channel in channels.values()):
                self._writer.flush()  # as above

    @property
    def counts(self) -> Counter[str]:
        """Messages by topic; complete once the file is finished."""
        return self._writer.counts

    def _number(self, schema: Schema | None, channel: Channel) -> int:
        ident = (channel.topic, schema.name if schema else "")
        if ident not in self._numbers:
            schema_id = 0
            if schema:
                schema_id = self._writer.register_schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            self._numbers[ident] = self._writer.register_channel(
                topic=channel.topic, message_encoding=channel.message_encoding, schema_id=schema_id
            )
        return self._numbers[ident]


@contextlib.contextmanager
def new_mcap(
    path: Path, header: Header, notes: Mapping[str, Mapping[str, Any]], attachments: Mapping[str, bytes]
) -> Generator[Copy]:
    """A new file to copy messages into; finished and durable after the block. Raises `OSError`."""
    with path.open("xb") as file:
        writer = start_mcap(file, header, notes, attachments)
        yield Copy(writer)
        writer.finish()
        sync(file)


def header_metadata(header: Header) -> dict[str, str]:
    """Header as MCAP metadata: every value as JSON, so that it reads back unchanged, and a CRC over all of them."""
    values = {name: json.dumps(value) for name, value in header.model_dump(mode="json").items()}
    return {**values, "crc": header_crc(values)}


def header_crc(values: dict[str, str]) -> str:
    """CRC-32 of a header's metadata, without `crc` itself."""
    texts = {name: text for name, text in values.items() if name != "crc"}
    return f"{zlib.crc32(json.dumps(texts, sort_keys=True).encode()):08x}"


def note(values: Mapping[str, Any]) -> dict[str, str]:
    """Values as MCAP metadata with a CRC."""
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    return {"json": text, "crc": f"{zlib.crc32(text.encode()):08x}"}


def read_note(metadata: dict[str, str]) -> dict[str, Any] | None:
    """Values of a note; None where it does not match its CRC. Raises `ValueError` where it is not a note."""
    text = metadata.get("json", "")
    if metadata.get("crc") != f"{zlib.crc32(text.encode()):08x}":
        return None
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("holds no values")
    return cast("dict[str, Any]", values)


def count_messages(path: Path) -> dict[str, int]:
    """Number of messages by topic, with every chunk's CRC checked. Raises `SessionDamaged`."""
    counts: Counter[str] = Counter()
    for contents, found in container.chunks(path):
        for number, index in contents.index.items():
            counts[found.channels[number].topic] += len(index) // 2
    return dict(counts)


def file_sha256(path: Path) -> str:
    """Hex digest of a file, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_digest(path: Path, sha256: str) -> None:
    """Raise `SessionDamaged` unless the file is byte for byte what was recorded."""
    if not path.is_file():
        raise SessionDamaged(path, "is missing, though the journal says it was finished")
    try:
        digest = file_sha256(path)
    except OSError as error:
        raise SessionDamaged(path, f"cannot read: {in_one_line(error)}") from None
    if digest != sha256:
        raise SessionDamaged(path, "has changed since it was recorded (sha256 differs from the journal)")
