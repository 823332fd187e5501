"""Reading MCAP files that a crash, a bad disk or a stranger may have changed.

The mcap library believes the lengths that a file states, and meets damage with a dozen kinds of error. Here lengths
are bounded before anything is read, the index is checked by its CRC, and damage is a `SessionDamaged` naming the file.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from sessions.errors import InputError, SessionDamaged, in_one_line
from sessions.recording.chunk import RECORD_START, Contents, unpacked

MAX_RECORD_BYTES = 512 * 1024 * 1024
"""Largest record that is read: a chunk is 512 KiB plus one message, the largest image allowed, with room to spare."""
UNREADABLE = (
    McapError,
    struct.error,
    zstandard.ZstdError,
    ValueError,
    RuntimeError,
    LookupError,
    ArithmeticError,
    EOFError,
    OSError,
    MemoryError,
)
"""Everything that mcap, zstd and the system raised in tests with damaged files."""

Record = tuple[Schema | None, Channel, Message]
_T = TypeVar("_T")


@dataclass(slots=True)
class Index:
    """The index at the end of a file; of each chunk only its place and its channels, a few bytes."""

    statistics: Statistics
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunk_offsets: array[int] = field(default_factory=lambda: array("Q"))
    chunk_channels: list[frozenset[int]] = field(default_factory=list[frozenset[int]])
    """Numbers of the channels of each chunk; empty where the index does not list them."""
    attachments: list[AttachmentIndex] = field(default_factory=list[AttachmentIndex])
    metadata: list[MetadataIndex] = field(default_factory=list[MetadataIndex])


def messages(path: Path, topics: list[str] | None = None) -> Iterator[Record]:
    """Messages in the order in which they were written, every CRC checked. Raises `SessionDamaged`.

    They are not sorted by log time: a stroke would precede its still if the host's clock was set back between the two.
    """
    return _guarded(path, lambda file: _messages(file, topics))


def messages_at(path: Path, offsets: Sequence[int], topics: Mapping[int, str]) -> Iterator[tuple[str, Message]]:
    """Topics and messages of the chunks at these places, by the channels' numbers; the index is not read. Raises
    `SessionDamaged`."""

    def read(file: BoundedFile) -> Iterator[tuple[str, Message]]:
        for offset in offsets:
            for message in chunk_at(file, offset).each(topics):
                yield topics[message.channel_id], message

    return _guarded(path, read)


def chunks_before(
    path: Path, last: str, kept: Sequence[str]
) -> Iterator[tuple[tuple[int, ...], dict[int, str], Message]]:
    """Each message on the topic `last`, with the places of its chunk and of those with messages on `kept` since the
    chunk of the one before, and the channels of all. Raises `SessionDamaged`."""

    def read(file: BoundedFile) -> Iterator[tuple[tuple[int, ...], dict[int, str], Message]]:
        index = indexed(file)
        topics = {number: channel.topic for number, channel in index.channels.items() if channel.topic in (last, *kept)}
        ends = {number for number, topic in topics.items() if topic == last}
        before: list[int] = []
        for offset, channels in zip(index.chunk_offsets, index.chunk_channels, strict=True):
            if not channels or channels & topics.keys():
                before.append(offset)
            if ends & channels:
                for message in chunk_at(file, offset).each(ends):
                    yield tuple(before), topics, message
                before = []

    return _guarded(path, read)


def chunks(path: Path) -> Iterator[tuple[Contents, Index]]:
    """Chunks in the order in which they were written, every CRC checked, and the file's index. Raises
    `SessionDamaged`."""
    return _guarded(path, lambda file: _chunks(file, None))


def metadata(path: Path) -> Iterator[Metadata]:
    """Metadata records. Raises `SessionDamaged`."""
    return _guarded(path, _metadata)


def attachments(path: Path) -> Iterator[Attachment]:
    """Attached files, byte for byte. Raises `SessionDamaged`."""
    return _guarded(path, _attachments)


def indexed_counts(path: Path) -> dict[str, int]:
    """Messages by topic according to the index, without reading them. Raises `SessionDamaged`."""
    return next(_guarded(path, _indexed_counts))


class BoundedFile(io.BufferedReader):
    """File whose reads are limited to what it holds, whatever length a damaged record states."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most what is left of the file."""
        left = max(self.size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


def _guarded(path: Path, read: Callable[[BoundedFile], Iterator[_T]]) -> Iterator[_T]:
    """Yield items; turn the library's exceptions into `SessionDamaged`, but not those of the code that uses an item."""
    try:
        file = BoundedFile(path)
    except OSError as error:
        raise InputError(path, f"cannot open: {in_one_line(error)}") from None
    with file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise InputError(path, "is not an MCAP file")
        file.seek(0)
        items: Iterator[_T] | None = None
        while True:
            try:
                items = items or read(file)
                item = next(items)
            except StopIteration:
                return
            except UNREADABLE as error:
                raise SessionDamaged(path, f"cannot read: {in_one_line(error)}") from None
            yield item


def indexed(file: BoundedFile) -> Index:
    """Return the index at the end of the file, its CRC checked. Raises any of `UNREADABLE`."""
    found = Index(Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0))
    known: dict[frozenset[int], frozenset[int]] = {}  # nearly all chunks have the same channels
    unfinished = True
    for record in index_records(file):
        match record:
            case Statistics():
                found.statistics, unfinished = record, False
            case Schema():
                found.schemas[record.id] = record
            case Channel():
                found.channels[record.id] = record
            case ChunkIndex():
                numbers = frozenset(record.message_index_offsets)
                found.chunk_offsets.append(record.chunk_start_offset)
                found.chunk_channels.append(known.setdefault(numbers, numbers))
            case AttachmentIndex():
                found.attachments.append(record)
            case MetadataIndex():
                found.metadata.append(record)
            case _:
                pass
    if unfinished:
        raise McapError("has no index: it was not finished")
    return found


def index_records(file: BoundedFile) -> Iterator[object]:
    """Records of the index at the end of the file, its CRC checked. Raises any of `UNREADABLE`."""
    file.seek(_summary_start(file))
    untyped: Iterator[object] = StreamReader(file, skip_magic=True, record_size_limit=MAX_RECORD_BYTES).records
    return untyped


def _summary_start(file: BoundedFile) -> int:
    """Check the CRC of the index: otherwise one wrong bit in it could silently hide strokes. Return its place."""
    footer_at = file.size - FOOTER_SIZE - len(MCAP0_MAGIC)
    file.seek(footer_at)
    _opcode, _length, summary_start, _offsets, expected = struct.unpack("<BQQQI", file.read(FOOTER_SIZE))
    if file.read() != MCAP0_MAGIC or not 0 < summary_start <= footer_at:
        raise McapError("has no index: it was not finished, or is cut short")
    file.seek(summary_start)
    crc, left = 0, file.size - len(MCAP0_MAGIC) - 4 - summary_start
    while left > 0:
        piece = file.read(min(left, 1 << 20))
        crc, left = zlib.crc32(piece, crc), left - len(piece)
    if crc != expected:
        raise McapError("the index does not match its CRC")
    return summary_start


def _messages(file: BoundedFile, topics: list[str] | None) -> Iterator[Record]:
    for contents, index in _chunks(file, topics):
        channels = {
            number: channel
            for number, channel in index.channels.items()
            if number in contents.index and (topics is None or channel.topic in topics)
        }
        schemas = {
            number: index.schemas[channel.schema_id] for number, channel in channels.items() if channel.schema_id
        }
        for message in contents.each(channels):
            yield schemas.get(message.channel_id), channels[message.channel_id], message


def _chunks(file: BoundedFile, topics: list[str] | None) -> Iterator[tuple[Contents, Index]]:
    """Chunks that may hold messages on `topics`."""
    index = indexed(file)
    if not index.chunk_offsets and index.statistics.message_count:
        raise McapError("has messages outside chunks, which no CRC protects")
    wanted = {number for number, channel in index.channels.items() if topics is None or channel.topic in topics}
    for offset, channels in zip(index.chunk_offsets, index.chunk_channels, strict=True):
        if topics is None or not channels or wanted & channels:
            contents = chunk_at(file, offset)
            if not contents.index.keys() <= index.channels.keys():
                raise McapError("a chunk has messages of a channel that the index does not list")
            yield contents, index


def chunk_at(file: BoundedFile, offset: int) -> Contents:
    """Read one chunk. Raises any of `UNREADABLE`."""
    check_chunk_at(file, offset)
    file.seek(offset)
    opcode, length = RECORD_START.unpack(file.read(RECORD_START.size))
    if opcode != Opcode.CHUNK or length > MAX_RECORD_BYTES:
        raise ValueError("no chunk")
    chunk = Chunk.read(ReadDataStream(io.BytesIO(file.read(length))))
    if chunk.uncompressed_crc == 0:
        raise ValueError("no CRC")
    return unpacked(chunk)


def check_chunk_at(file: BoundedFile, offset: int) -> None:
    """Raise `McapError` for a chunk if any of its three lengths exceeds `MAX_RECORD_BYTES`."""
    file.seek(offset + 1 + 8 + 8 + 8)
    stream = ReadDataStream(file)
    size = stream.read8()
    stream.read4()
    compression = stream.read_prefixed_string()
    size = max(size, stream.read8())
    if compression == "zstd":
        size = max(size, zstandard.frame_content_size(stream.read(18)))
    elif compression:
        raise McapError(f"chunk compressed by {compression!r}, allowed: zstd or none")
    if size > MAX_RECORD_BYTES:
        raise McapError(f"chunk of {size} bytes exceeds {MAX_RECORD_BYTES}")


def _metadata(file: BoundedFile) -> Iterator[Metadata]:
    for one in indexed(file).metadata:
        record = _record_at(file, one.offset)
        if not isinstance(record, Metadata):
            raise McapError("the index names metadata where there is none")
        yield record


def _attachments(file: BoundedFile) -> Iterator[Attachment]:
    for one in indexed(file).attachments:
        record = _record_at(file, one.offset)
        if not isinstance(record, Attachment):
            raise McapError("the index names an attachment where there is none")
        again = RecordBuilder()
        record.write(again)
        file.seek(one.offset)
        if file.read(one.length) != again.end():  # the reader skips the CRC of an attachment
            raise McapError(f"attachment {record.name!r} does not match its CRC")
        yield record


def _record_at(file: BoundedFile, offset: int) -> object:
    file.seek(offset)
    untyped: Iterator[object] = StreamReader(file, skip_magic=True, record_size_limit=MAX_RECORD_BYTES).records
    return next(untyped)


def _indexed_counts(file: BoundedFile) -> Iterator[dict[str, int]]:
    index = indexed(file)
    counts = index.statistics.channel_message_counts
    yield {index.channels[channel_id].topic: count for channel_id, count in counts.items()}
