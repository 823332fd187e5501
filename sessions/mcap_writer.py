"""Writes MCAP files: records in compressed chunks, each with its CRC and its index, and the index of the file.

The mcap library's writer reaches .6 of the rate of foxglove-sdk, because it packs a message field by field and copies
it four times. Here one `struct` packs all fields, and the library packs what is written rarely.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable, Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import IO, Any, Protocol

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
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.records import Header as FileHeader
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.disk import sync
from brushloop.sessions.mcap_file import MESSAGE_START, RECORD_START, open_mcap
from brushloop.sessions.records import HEADER_METADATA, Header, Topic, header_metadata, note

CHUNK_BYTES = 256 * 1024
_CHUNK_START = struct.Struct("<BQQQQII4sQ")
_INDEX_START = struct.Struct("<BQHI")
_FOOTER_START = struct.Struct("<BQQQ")
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}


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
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()
        self._numbers: dict[tuple[str, str], int] = {}
        """Of the channels to which messages of other files are copied, by topic and name of the schema."""
        self._crc = 0
        """Of everything written to the file so far."""
        self._write(MCAP0_MAGIC)
        self._write(_packed(FileHeader(profile="", library=library)))

    @property
    def counts(self) -> Counter[str]:
        """Number of messages by topic, without those of the chunk in progress."""
        counts: Counter[str] = Counter()
        for number, count in self._counts.items():
            counts[self.channels[number].topic] += count
        return counts

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write metadata."""
        offset = self._file.tell()
        length = self._write(_packed(Metadata(name=name, metadata=data)))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attached file."""
        offset = self._file.tell()
        length = self._write(_packed(Attachment(0, 0, name, media_type, data)))
        self._attachments.append(AttachmentIndex(offset, length, 0, 0, len(data), name, media_type))

    def add_channel(self, schema: Schema | None, channel: Channel) -> None:
        """Put a channel and its schema into the chunk in progress; their numbers must be free."""
        for record in (schema, channel) if schema is not None else (channel,):
            self._records += _packed(record)
        self._list(schema, channel)

    def add_message(self, *, channel_id: int, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        """Add a message to the chunk in progress."""
        records = self._records
        self._index[channel_id] += (log_time, len(records))
        size = MESSAGE_START.size - RECORD_START.size + len(data)
        records += MESSAGE_START.pack(Opcode.MESSAGE, size, channel_id, sequence, log_time, publish_time)
        records += data
        if len(records) > CHUNK_BYTES:
            self._end_chunk()

    def add(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """Add a message of another file as it is: times, sequence number and data stay."""
        self.add_message(
            channel_id=self._number(schema, channel),
            log_time=message.log_time,
            publish_time=message.publish_time,
            sequence=message.sequence,
            data=message.data,
        )
        if channel.topic == Topic.STROKE:
            self.flush()  # ends the chunk, so that a damaged chunk costs one stroke

    def add_file(self, path: Path) -> None:
        """Add all messages of a file as they are, every CRC checked. Raises `SessionDamaged`.

        Chunks are copied whole where the numbers of the channels agree, as they do in files of one session.
        """
        source = open_mcap(path)
        channels = list(source.channels.values())
        if not all(self._fits(*pair) for pair in channels):
            for record in source.messages():
                self.add(*record)
            return
        for pair in channels:
            self._list(*pair)
        for packed in source.packed_chunks():
            self._add_chunk(*packed)

    def flush(self) -> None:
        """End the chunk in progress unless it has no messages, and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """End the chunk in progress and write the index. The file stays open."""
        self._end_chunk()
        self._write(_packed(DataEnd(self._crc)))
        start = self._file.tell()
        groups: list[tuple[Opcode, Iterable[_Writable]]] = [
            (Opcode.SCHEMA, self.schemas.values()),
            (Opcode.CHANNEL, self.channels.values()),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        summary = bytearray()
        offsets: list[SummaryOffset] = []
        for opcode, records in groups:
            begin = len(summary)
            for record in records:
                summary += _packed(record)
            offsets.append(SummaryOffset(opcode, start + begin, len(summary) - begin))
        offsets_start = start + len(summary)
        summary += b"".join(map(_packed, offsets))
        footer = _FOOTER_START.pack(Opcode.FOOTER, 8 + 8 + 4, start, offsets_start)
        self._write(summary)
        self._write(_packed(Footer(start, offsets_start, zlib.crc32(footer, zlib.crc32(summary)))))
        self._write(MCAP0_MAGIC)

    def _fits(self, schema: Schema | None, channel: Channel) -> bool:
        """Whether the numbers of a channel and its schema are free, or stand for exactly these."""
        return self.channels.get(channel.id, channel) == channel and (
            schema is None or self.schemas.get(schema.id, schema) == schema
        )

    def _list(self, schema: Schema | None, channel: Channel) -> None:
        """List a channel in the index only: a chunk of another file brings its record along."""
        if schema is not None:
            self.schemas[schema.id] = schema
        self.channels[channel.id] = channel

    def _number(self, schema: Schema | None, channel: Channel) -> int:
        """Number of the channel for messages of this channel of another file."""
        ident = (channel.topic, schema.name if schema else "")
        if ident not in self._numbers:
            known = {(one.topic, self._schema_name(one)): number for number, one in self.channels.items()}
            if ident not in known:
                if not self._fits(schema, channel):
                    number = max([*self.channels, *self.schemas]) + 1
                    schema = replace(schema, id=number) if schema else None
                    channel = replace(channel, id=number, schema_id=number if schema else 0)
                self.add_channel(schema, channel)
            self._numbers[ident] = known.get(ident, channel.id)
        return self._numbers[ident]

    def _schema_name(self, channel: Channel) -> str:
        return self.schemas[channel.schema_id].name if channel.schema_id else ""

    def _add_chunk(self, data: bytes, index: ChunkIndex, counts: Mapping[int, int]) -> None:
        """Add a chunk of another file as it is, with the indexes of its messages; `index` says where it was there."""
        self._end_chunk()
        shift = self._file.tell() - index.chunk_start_offset
        self._write(data)
        offsets = {number: at + shift for number, at in index.message_index_offsets.items()}
        start = index.chunk_start_offset + shift
        self._chunks.append(replace(index, chunk_start_offset=start, message_index_offsets=offsets))
        self._counts.update(counts)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self.schemas),
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
        self._write(_CHUNK_START.pack(Opcode.CHUNK, *header, len(packed)))
        self._write(packed)
        at, offsets = start + length, dict[int, int]()
        for number, index in self._index.items():
            offsets[number] = at
            size = 8 * len(index)
            at += self._write(_INDEX_START.pack(Opcode.MESSAGE_INDEX, 2 + 4 + size, number, size))
            at += self._write(struct.pack(f"<{len(index)}Q", *index))
            self._counts[number] += len(index) // 2
        self._chunks.append(
            ChunkIndex(
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
        )
        self._index.clear()
        self._records = bytearray()

    def _write(self, data: bytes | bytearray) -> int:
        self._crc = zlib.crc32(data, self._crc)
        return self._file.write(data)


def _packed(record: _Writable) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


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


@contextlib.contextmanager
def new_mcap(
    path: Path, header: Header, notes: Mapping[str, Mapping[str, Any]], attachments: Mapping[str, bytes]
) -> Generator[McapWriter]:
    """A new file to copy messages into; finished and durable after the block. Raises `OSError`."""
    with path.open("xb") as file:
        writer = start_mcap(file, header, notes, attachments)
        yield writer
        writer.finish()
        sync(file)
