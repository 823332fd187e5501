"""Write MCAP files: what comes before the messages (header, notes, attachments), and the messages themselves.

Metadata has no CRC in MCAP, so the header and each note include one.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath
from typing import IO, Any, cast

from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from sessions.disk import sync
from sessions.errors import SessionDamaged, in_one_line
from sessions.recording.container import Record, messages
from sessions.recording.schemas import Header, Topic

CHUNK_BYTES = 256 * 1024
HEADER_METADATA = "brushloop.header"
BEGIN_NOTE, DONE_NOTE = "brushloop.begin", "brushloop.done"
"""Notes of a step's file: the journal's lines about it, so that a lost journal can be rebuilt."""
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


def start_mcap(
    file: IO[bytes], header: Header, notes: Mapping[str, Mapping[str, Any]], attachments: Mapping[str, bytes]
) -> Writer:
    """Begin an MCAP file with everything that comes before its messages."""
    writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile="", library=header.software)
    writer.add_metadata(HEADER_METADATA, header_metadata(header))
    for name, values in notes.items():
        writer.add_metadata(name, note(values))
    for name, data in attachments.items():
        media_type = _MEDIA_TYPES.get(PurePath(name).suffix, "application/octet-stream")
        writer.add_attachment(0, 0, name, media_type, data)
    return writer


def write_mcap(
    path: Path,
    header: Header,
    notes: Mapping[str, Mapping[str, Any]],
    attachments: Mapping[str, bytes],
    records: Iterable[Record],
) -> Counter[str]:
    """Write a new file, durable on return, and return its number of messages by topic. Raises `OSError`."""
    written: Counter[str] = Counter()
    with path.open("xb") as file:
        writer = start_mcap(file, header, notes, attachments)
        channels: dict[tuple[str, str], int] = {}
        for schema, channel, message in records:
            ident = (channel.topic, schema.name if schema else "")
            if ident not in channels:
                channels[ident] = _register(writer, schema, channel)
            _copy(writer, channels[ident], channel, message)
            written[channel.topic] += 1
        writer.finish()
        sync(file)
    return written


def _register(writer: Writer, schema: Schema | None, channel: Channel) -> int:
    schema_id = 0
    if schema:
        schema_id = writer.register_schema(name=schema.name, encoding=schema.encoding, data=schema.data)
    return writer.register_channel(topic=channel.topic, message_encoding=channel.message_encoding, schema_id=schema_id)


def _copy(writer: Writer, channel_id: int, channel: Channel, message: Message) -> None:
    """Write one message, keeping its times and sequence number."""
    writer.add_message(
        channel_id=channel_id,
        log_time=message.log_time,
        publish_time=message.publish_time,
        sequence=message.sequence,
        data=message.data,
    )
    if channel.topic == Topic.STROKE:
        writer.flush()  # ends the chunk, so that a damaged chunk costs one stroke


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
    return dict(Counter(channel.topic for _schema, channel, _message in messages(path)))


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
