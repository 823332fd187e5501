"""The index of an MCAP file, and the records at the places that it gives, with every length bounded before it is read.

The mcap library believes the lengths that a file states. Damage and unfinished files raise any of `UNREADABLE`;
`container.py` turns that into an error that names the file.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import AttachmentIndex, Channel, Chunk, ChunkIndex, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.errors import InputError, in_one_line
from brushloop.sessions.recording.chunk import RECORD_START, Contents, unpacked

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
)
"""Everything that mcap, zstd and the system raised in tests with damaged files.

Not `MemoryError`: too little memory says nothing about a file. Lengths are bounded before anything is read.
"""


class BoundedFile(io.BufferedReader):
    """File whose reads are limited to what it holds, whatever length a damaged record states."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most what is left of the file."""
        left = max(self.size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


def opened(path: Path) -> BoundedFile:
    """Open a recording. Raises `InputError`."""
    try:
        return BoundedFile(path)
    except OSError as error:
        raise InputError(path, f"cannot open: {in_one_line(error)}") from None


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
    try:
        return unpacked(chunk)
    except zstandard.ZstdError as error:
        if "not enough memory" in str(error):
            raise MemoryError from None
        raise


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


def record_at(file: BoundedFile, offset: int) -> object:
    """Read the record at this place. Raises any of `UNREADABLE`."""
    file.seek(offset)
    untyped: Iterator[object] = StreamReader(file, skip_magic=True, record_size_limit=MAX_RECORD_BYTES).records
    return next(untyped)
