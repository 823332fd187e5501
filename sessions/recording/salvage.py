"""Read what is intact in a damaged MCAP file: every chunk that matches its CRC, and nothing else.

The file is read record by record. If a wrong length stops this, the index at the end, if it is intact, gives
the offsets of the other chunks. A torn tail never yields a wrong record.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.errors import in_one_line
from brushloop.sessions.recording.chunk import RECORD_START
from brushloop.sessions.recording.container import Record
from brushloop.sessions.recording.index import (
    MAX_RECORD_BYTES,
    UNREADABLE,
    BoundedFile,
    check_chunk_at,
    chunk_at,
    index_records,
    indexed,
    opened,
)
from brushloop.sessions.recording.mcap_file import HEADER_METADATA, header_crc, read_note
from brushloop.sessions.recording.parts import Part, Parts

_STROKE_NAME = re.compile(rb'"stroke_id":"([^"\\]{1,100})","kind"')
"""Beginning of a stroke's message."""
_PIECE_BYTES = 256
_MESSAGE_INDEX = struct.Struct("<HI")


@dataclass(slots=True)
class Scan:
    """Where the sound parts of a file lie, and what is wrong with the rest."""

    path: Path
    parts: Parts = field(default_factory=Parts)
    """Known chunks, in order."""
    complete: bool = False
    """Whether all chunks are known: the walk reached the end, or the index is intact."""
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    notes: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Our own notes (`brushloop.begin`, ...) that match their CRC."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    """All metadata; the format gives it no CRC."""
    attachments: list[Attachment] = field(default_factory=list[Attachment])
    counts: Counter[str] = field(default_factory=Counter[str])
    stated: dict[str, int] | None = None
    """Number of messages by topic according to the index; None if it is damaged."""
    stated_attachments: int = 0
    stated_notes: frozenset[str] = frozenset()
    """Names of the notes listed in the index, and of the header."""
    damage: list[str] = field(default_factory=list[str])
    """Descriptions of the damage; empty for an intact file."""


def scan(path: Path) -> Scan:
    """Read every record. Raises `InputError` where the file cannot be opened; damage is reported, never raised."""
    found = Scan(path)
    with opened(path) as file:
        try:
            offsets = _walk(file, found)
            if missed := _from_index(file, found, offsets):
                offsets = array("Q", sorted([*offsets, *missed]))
        except OSError as error:
            found.damage.append(f"cannot be read: {in_one_line(error)}")
            return found
        for offset in offsets:
            counts = None
            try:
                counts = Counter(channel.topic for _schema, channel, _message in _chunk(file, offset, found))
                found.counts += counts
            except UNREADABLE as error:
                found.damage.append(f"a chunk at byte {offset} cannot be read ({in_one_line(error)})")
            found.parts.append(Part(offset, counts, sound=counts is not None))
        if any(not part.sound for part in found.parts):
            sound, found.parts = found.parts, Parts()
            for part in sound:  # every channel is known only now
                found.parts.append(
                    part if part.sound else Part(part.offset, _indexed_counts(file, found, part.offset), False)
                )
    return found


def recorded_in(found: Scan) -> str:
    """Id of the session whose header a file holds; empty where it holds none that matches its CRC."""
    metadata = found.metadata.get(HEADER_METADATA, {})
    try:
        session = json.loads(metadata.get("session_id", '""'))
    except (ValueError, RecursionError):
        return ""
    return session if isinstance(session, str) and metadata.get("crc") == header_crc(metadata) else ""


def session_of(path: Path) -> str:
    """`recorded_in` of a file whose chunks are not read. Raises `InputError` where it cannot be opened."""
    found = Scan(path)
    with opened(path) as file:
        try:
            _walk(file, found)
        except OSError:
            return ""
    return recorded_in(found)


def _indexed_counts(file: BoundedFile, found: Scan, offset: int) -> Counter[str] | None:
    """Number of messages in a chunk by topic, from the index records after it; None without them."""
    try:
        by_channel = _after_chunk(file, offset) or _named_by_index(file, offset)
    except UNREADABLE:
        return None
    if not by_channel or not by_channel.keys() <= found.channels.keys():
        return None
    return Counter({found.channels[number].topic: count for number, count in by_channel.items()})


def _after_chunk(file: BoundedFile, offset: int) -> dict[int, int]:
    """Number of messages by channel, from the index records that follow the chunk; none if its length is wrong."""
    by_channel: dict[int, int] = {}
    at = offset
    while True:
        file.seek(at)
        start = file.read(RECORD_START.size)
        if len(start) < RECORD_START.size:
            return by_channel
        opcode, length = RECORD_START.unpack(start)
        if opcode == Opcode.MESSAGE_INDEX:
            by_channel |= _message_index(file)
        elif at != offset:
            return by_channel
        at += RECORD_START.size + length


def _named_by_index(file: BoundedFile, offset: int) -> dict[int, int]:
    """The same from the index records that the index of the file names. Raises any of `UNREADABLE`."""
    by_channel: dict[int, int] = {}
    for record in index_records(file):
        if isinstance(record, ChunkIndex) and record.chunk_start_offset == offset:
            for place in record.message_index_offsets.values():
                file.seek(place + RECORD_START.size)
                by_channel |= _message_index(file)
            break
    return by_channel


def salvaged(found: Scan) -> Iterator[Record]:
    """Messages of the sound chunks, in the order in which they were written. Raises `OSError`."""
    for part in found.parts:
        if part.sound:
            yield from read_part(found, part)


def read_part(found: Scan, part: Part) -> Iterator[Record]:
    """Messages of one sound chunk. Raises `OSError`."""
    with BoundedFile(found.path) as file:
        yield from _chunk(file, part.offset, found)


def glimpsed(found: Scan) -> list[str]:
    """Names of strokes still visible in damaged chunks, as far as these can be unpacked."""
    names: dict[str, None] = {}
    with BoundedFile(found.path) as file:
        for part in found.parts:
            if part.sound:
                continue
            try:
                check_chunk_at(file, part.offset)
                file.seek(part.offset)
                _opcode, length = RECORD_START.unpack(file.read(RECORD_START.size))
                chunk = Chunk.read(ReadDataStream(io.BytesIO(file.read(length))))
                data = _unpacked(chunk.data) if chunk.compression else chunk.data
            except UNREADABLE:
                continue
            names |= {name.decode("utf-8", "replace"): None for name in _STROKE_NAME.findall(data)}
    return list(names)


def _unpacked(data: bytes) -> bytes:
    unpacked = bytearray()
    stream = zstandard.ZstdDecompressor().decompressobj()
    try:
        for at in range(0, len(data), _PIECE_BYTES):
            unpacked += stream.decompress(data[at : at + _PIECE_BYTES])
    except zstandard.ZstdError:
        pass  # keep what was unpacked before the error
    return bytes(unpacked)


def _walk(file: BoundedFile, found: Scan) -> array[int]:
    """Offsets of possible chunks, up to the end or to the first record that cannot be read."""
    offsets = array("Q")
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        found.damage.append("does not begin as an MCAP file does")
    at = len(MCAP0_MAGIC)
    while True:
        file.seek(at)
        start = file.read(RECORD_START.size)
        if len(start) < RECORD_START.size:
            found.damage.append(f"ends at byte {file.size} without an index")
            return offsets
        opcode, length = RECORD_START.unpack(start)
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END:
            found.damage.append(f"no record can be read at byte {at}")
            return offsets
        if at + RECORD_START.size + length > file.size:
            found.damage.append(f"is cut short in the record at byte {at}")
            return offsets
        if opcode == Opcode.CHUNK:
            offsets.append(at)
        elif opcode != Opcode.MESSAGE_INDEX:
            _record(file, found, opcode, at, length)
        at += RECORD_START.size + length
        if opcode == Opcode.DATA_END:
            found.complete = True
            return offsets


def _message_index(file: BoundedFile) -> dict[int, int]:
    """A channel's number of messages in a chunk: the record holds the channel's number and 16 bytes a message."""
    start = file.read(_MESSAGE_INDEX.size)
    if len(start) < _MESSAGE_INDEX.size:
        return {}
    channel, length = _MESSAGE_INDEX.unpack(start)
    return {channel: length // 16}


def _record_at(file: BoundedFile, found: Scan, offset: int) -> None:
    """Read a record that only the index lists."""
    file.seek(offset)
    start = file.read(RECORD_START.size)
    if len(start) == RECORD_START.size:
        opcode, length = RECORD_START.unpack(start)
        _record(file, found, opcode, offset, length)


def _record(file: BoundedFile, found: Scan, opcode: int, at: int, length: int) -> None:
    if opcode not in (Opcode.METADATA, Opcode.ATTACHMENT) or length > MAX_RECORD_BYTES:
        return
    data = file.read(length)
    try:
        if opcode == Opcode.METADATA:
            _metadata(Metadata.read(ReadDataStream(io.BytesIO(data))), found)
        elif struct.unpack("<I", data[-4:])[0] != zlib.crc32(data[:-4]):
            found.damage.append(f"an attachment at byte {at} does not match its CRC")
        else:
            found.attachments.append(Attachment.read(ReadDataStream(io.BytesIO(data))))
    except UNREADABLE as error:
        found.damage.append(f"the record at byte {at} cannot be read ({in_one_line(error)})")


def _metadata(record: Metadata, found: Scan) -> None:
    found.metadata[record.name] = record.metadata
    if record.name == HEADER_METADATA:
        if record.metadata.get("crc", "") not in ("", header_crc(record.metadata)):
            found.damage.append("its header does not match its CRC")
    elif "crc" in record.metadata:
        values = read_note(record.metadata)
        if values is None:
            found.damage.append(f"its note {record.name!r} does not match its CRC")
        else:
            found.notes[record.name] = values


def _from_index(file: BoundedFile, found: Scan, known: array[int]) -> list[int]:
    """Return offsets of chunks that only the index lists, and add its channels, which a lost chunk may have held."""
    try:
        index = indexed(file)
    except UNREADABLE as error:
        found.damage.append(f"its index cannot be read ({in_one_line(error)})")
        return []
    found.schemas.update(index.schemas)
    found.channels.update(index.channels)
    counts = index.statistics.channel_message_counts
    found.stated = {found.channels[key].topic: count for key, count in counts.items() if key in found.channels}
    found.stated_attachments = len(index.attachments)
    found.stated_notes = frozenset(one.name for one in index.metadata)
    found.complete = True
    for one in index.metadata:
        if one.name not in found.metadata:
            _record_at(file, found, one.offset)
    if known == index.chunk_offsets:
        return []  # without the memory that two sets take
    walked = set(known)
    missed = [offset for offset in index.chunk_offsets if offset not in walked]
    if len(missed) + len(known) > len(index.chunk_offsets):
        found.damage.append("holds chunks that its index does not list")
    return missed


def _chunk(file: BoundedFile, offset: int, found: Scan) -> Iterator[Record]:
    """Return all messages of one chunk, or raise one of `UNREADABLE`."""
    contents = chunk_at(file, offset)
    found.schemas.update({schema.id: schema for schema in contents.schemas})
    found.channels.update({channel.id: channel for channel in contents.channels})
    pairs = [(found.channels[message.channel_id], message) for message in contents.each()]
    return iter([(found.schemas[ch.schema_id] if ch.schema_id else None, ch, message) for ch, message in pairs])
