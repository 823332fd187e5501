"""Writes MCAP files: records in compressed chunks, each with its CRC and its index, and the index of the file.

The mcap library's writer takes most of the recorder's time, because it packs a message field by field and copies it
four times. Here one `struct` packs all fields; the library's records are used for everything that is written rarely.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import tempfile
import weakref
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import IO, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.recording.chunk import MESSAGE_START, RECORD_START, Contents

CHUNK_BYTES = 256 * 1024
_CHUNK_START = struct.Struct("<BQQQQII4sQ")
_INDEX_START = struct.Struct("<BQHI")
_FOOTER_START = struct.Struct("<BQQQ")
_CHANNEL = struct.Struct("<H")
INDEX_IN_MEMORY_BYTES = 64 * 1024
"""A longer index of chunks waits in a temporary file: about 100 bytes for each chunk."""


class _Writable(Protocol):
    def write(self, stream: RecordBuilder) -> None: ...


class McapWriter:
    """Writes one file, from its header to `finish`. What is buffered reaches the file with `flush`. Never fsyncs."""

    def __init__(self, file: IO[bytes], library: str) -> None:
        self._file = file
        self._compressor = zstandard.ZstdCompressor(level=1)  # smaller here than level 3, and faster
        self._records = bytearray()
        """Records of the chunk in progress."""
        self._index: defaultdict[int, list[int]] = defaultdict(list)
        """Log time and offset of each message of that chunk, one after the other, by channel."""
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks = tempfile.SpooledTemporaryFile(INDEX_IN_MEMORY_BYTES)  # noqa: SIM115
        """Their records in the index of the file."""
        weakref.finalize(self, self._chunks.close)
        self._chunk_count, self._first_ns, self._last_ns = 0, 0, 0
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()
        file.write(MCAP0_MAGIC)
        self._write(Header(profile="", library=library))

    @property
    def counts(self) -> Counter[str]:
        """Number of messages by topic, without those of the chunk in progress."""
        counts: Counter[str] = Counter()
        for number, count in self._counts.items():
            counts[self._channels[number - 1].topic] += count
        return counts

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write metadata."""
        offset = self._file.tell()
        length = self._write(Metadata(name=name, metadata=data))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attached file."""
        offset = self._file.tell()
        length = self._write(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        self._attachments.append(AttachmentIndex(offset, length, 0, 0, len(data), name, media_type))

    def register_schema(self, *, name: str, encoding: str, data: bytes) -> int:
        """Put a schema into the chunk in progress; return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._records += _packed(schema)
        return schema.id

    def register_channel(self, *, topic: str, message_encoding: str, schema_id: int) -> int:
        """Put a channel into the chunk in progress; return its number. Schema 0 is none."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=message_encoding, metadata={}, schema_id=schema_id)
        self._channels.append(channel)
        self._records += _packed(channel)
        return number

    def add_message(self, *, channel_id: int, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        """Add a message to the chunk in progress."""
        records = self._records
        self._index[channel_id] += (log_time, len(records))
        size = MESSAGE_START.size - RECORD_START.size + len(data)
        records += MESSAGE_START.pack(Opcode.MESSAGE, size, channel_id, sequence, log_time, publish_time)
        records += data
        if len(records) > CHUNK_BYTES:
            self._end_chunk()

    def add_contents(self, contents: Contents, numbers: Mapping[int, int]) -> None:
        """Add all messages of a chunk of another file as they are; `numbers` are its channels' numbers in this file."""
        shift = len(self._records)
        self._records += contents.messages
        for channel, index in contents.index.items():
            number = numbers[channel]
            for log_ns, offset in zip(index[::2], index[1::2], strict=True):
                self._index[number] += (log_ns, offset + shift)
                if number != channel:
                    _CHANNEL.pack_into(self._records, offset + shift + RECORD_START.size, number)
        if len(self._records) > CHUNK_BYTES:
            self._end_chunk()

    def flush(self) -> None:
        """End the chunk in progress unless it has no messages, and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """End the chunk in progress and write the index. The file stays open."""
        self._end_chunk()
        self._write(DataEnd(0))
        summary_start = self._file.tell()
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_packed, self._schemas)),
            (Opcode.CHANNEL, map(_packed, self._channels)),
            (Opcode.STATISTICS, [_packed(self._statistics())]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes()),
            (Opcode.ATTACHMENT_INDEX, map(_packed, self._attachments)),
            (Opcode.METADATA_INDEX, map(_packed, self._metadata)),
        ]
        crc, at = 0, summary_start
        offsets: list[bytes] = []
        for opcode, pieces in groups:
            begin = at
            for piece in pieces:
                crc, at = zlib.crc32(piece, crc), at + self._file.write(piece)
            offsets.append(_packed(SummaryOffset(opcode, begin, at - begin)))
        for piece in offsets:
            crc = zlib.crc32(piece, crc)
            self._file.write(piece)
        footer = _FOOTER_START.pack(Opcode.FOOTER, 8 + 8 + 4, summary_start, at)
        self._write(Footer(summary_start, at, zlib.crc32(footer, crc)))
        self._file.write(MCAP0_MAGIC)

    def _chunk_indexes(self) -> Iterator[bytes]:
        """Their packed records, in pieces."""
        self._chunks.seek(0)
        while piece := self._chunks.read(INDEX_IN_MEMORY_BYTES):
            yield piece

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunk_count,
            message_count=self._counts.total(),
            message_end_time=self._last_ns,
            message_start_time=self._first_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _end_chunk(self) -> None:
        if not self._index:
            return  # schemas and channels wait for their first message
        start, records = self._file.tell(), self._records
        first_ns = min(min(index[::2]) for index in self._index.values())
        last_ns = max(max(index[::2]) for index in self._index.values())
        packed = self._compressor.compress(records)
        length = _CHUNK_START.size + len(packed)
        header = (length - RECORD_START.size, first_ns, last_ns, len(records), zlib.crc32(records), 4, b"zstd")
        self._file.write(_CHUNK_START.pack(Opcode.CHUNK, *header, len(packed)))
        self._file.write(packed)
        at, offsets = start + length, dict[int, int]()
        for number, index in self._index.items():
            offsets[number] = at
            size = 8 * len(index)
            self._file.write(_INDEX_START.pack(Opcode.MESSAGE_INDEX, 2 + 4 + size, number, size))
            self._file.write(struct.pack(f"<{len(index)}Q", *index))
            at += _INDEX_START.size + size
            self._counts[number] += len(index) // 2
        self._first_ns = min(first_ns, self._first_ns) if self._chunk_count else first_ns
        self._last_ns = max(last_ns, self._last_ns)
        self._chunk_count += 1
        index_record = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=start,
            compression="zstd",
            compressed_size=len(packed),
            message_end_time=last_ns,
            message_index_length=at - start - length,
            message_index_offsets=offsets,
            message_start_time=first_ns,
            uncompressed_size=len(records),
        )
        self._chunks.write(_packed(index_record))
        self._index.clear()
        self._records = bytearray()

    def _write(self, record: _Writable) -> int:
        return self._file.write(_packed(record))


def _packed(record: _Writable) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
