"""Reading MCAP files that a crash, a bad disk or a stranger may have changed.

The mcap library believes the lengths that a file states, and meets damage with a dozen kinds of error. Here lengths
are bounded before anything is read, the index is checked by its CRC, and damage is a `SessionDamaged` naming the file.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, SeekingReader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.summary import Summary
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


def messages(path: Path, topics: list[str] | None = None) -> Iterator[Record]:
    """Messages in the order in which they were written, every CRC checked. Raises `SessionDamaged`.

    They are not sorted by log time: a stroke would precede its still if the host's clock was set back between the two.
    """
    return _guarded(path, lambda file: _messages(file, topics))


def chunks(path: Path) -> Iterator[tuple[Contents, Summary]]:
    """Chunks in the order in which they were written, every CRC checked, and the file's index. Raises
    `SessionDamaged`."""
    return _guarded(path, lambda file: _chunks(file, None))


def metadata(path: Path) -> Iterator[Metadata]:
    """Metadata records. Raises `SessionDamaged`."""
    return _guarded(path, lambda file: indexed(file)[0].iter_metadata())


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


def indexed(file: BoundedFile) -> tuple[SeekingReader, Summary]:
    """Return a reader, and the index at the end of the file with its CRC checked. Raises any of `UNREADABLE`."""
    file.seek(0)
    reader = SeekingReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
    _check_summary_crc(file)
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        raise McapError("has no index: it was not finished")
    return reader, summary


def _check_summary_crc(file: BoundedFile) -> None:
    """Check the CRC of the index: otherwise one wrong bit in it could silently hide strokes."""
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


def _messages(file: BoundedFile, topics: list[str] | None) -> Iterator[Record]:
    for contents, summary in _chunks(file, topics):
        channels = {
            number: channel
            for number, channel in summary.channels.items()
            if number in contents.index and (topics is None or channel.topic in topics)
        }
        schemas = {
            number: summary.schemas[channel.schema_id] for number, channel in channels.items() if channel.schema_id
        }
        for message in contents.each(channels):
            yield schemas.get(message.channel_id), channels[message.channel_id], message


def _chunks(file: BoundedFile, topics: list[str] | None) -> Iterator[tuple[Contents, Summary]]:
    """Chunks that may hold messages on `topics`."""
    _reader, summary = indexed(file)
    if not summary.chunk_indexes and (summary.statistics is None or summary.statistics.message_count):
        raise McapError("has messages outside chunks, which no CRC protects")
    wanted = {number for number, channel in summary.channels.items() if topics is None or channel.topic in topics}
    for index in summary.chunk_indexes:
        if topics is None or not index.message_index_offsets or wanted & index.message_index_offsets.keys():
            contents = chunk_at(file, index.chunk_start_offset)
            if not contents.index.keys() <= summary.channels.keys():
                raise McapError("a chunk has messages of a channel that the index does not list")
            yield contents, summary


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


def _attachments(file: BoundedFile) -> Iterator[Attachment]:
    reader, summary = indexed(file)
    for index, attachment in zip(summary.attachment_indexes, reader.iter_attachments(), strict=True):
        again = RecordBuilder()
        attachment.write(again)
        file.seek(index.offset)
        if file.read(index.length) != again.end():  # the reader skips the CRC of an attachment
            raise McapError(f"attachment {attachment.name!r} does not match its CRC")
        yield attachment


def _indexed_counts(file: BoundedFile) -> Iterator[dict[str, int]]:
    _reader, summary = indexed(file)
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    yield {summary.channels[channel_id].topic: count for channel_id, count in counts.items()}
