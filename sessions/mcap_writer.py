"""Writes MCAP files: records in compressed chunks, each with its CRC and its index, and the index of the file.

The mcap library's writer reaches .6 of the rate of foxglove-sdk, because it packs a message field by field and copies
it four times. Here one `struct` packs all fields, and the library packs what is written rarely.
Format: https://mcap.dev/spec

A step's file is written by a thread of its own from a queue, and is durable when `finish` returns. A kill -9 loses at
most the last 250 ms of a step, and that step is done again anyway.
"""

from __future__ import annotations

import contextlib
import functools
import json
import queue
import struct
import threading
import time
import zlib
from collections import Counter, defaultdict
from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

import zstandard
from mcap import records as mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, McapRecord, Message, Schema
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.disk import file_sha256, fsync_folder, sync
from brushloop.sessions.errors import SessionDamaged, SessionError, disk_error
from brushloop.sessions.mcap_file import MESSAGE_START, RECORD_START, McapFile
from brushloop.sessions.records import HEADER_FILE, Event, Header, Topic

if TYPE_CHECKING:
    from google.protobuf.message import Message as Protobuf

CHUNK_BYTES = 256 * 1024
FLUSH_S = 0.25
QUEUE_LIMIT = 20_000
"""Queue size, about 200 s of poses: a full queue means that the disk does not keep up, which is an error."""
NUMBERS = {topic: number for number, topic in enumerate(Topic, 1)}
"""A topic has the same number in every file, so that a merge can copy chunks as they are: new topics come last."""
_INDEX_START = struct.Struct("<BQHI")


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message on its way to a file."""

    topic: Topic
    log_ns: int
    publish_ns: int
    sequence: int
    message: Event | Protobuf


def encoded(message: Event | Protobuf) -> bytes:
    """The message as it is recorded: an event as JSON, anything else as protobuf."""
    if isinstance(message, Event):
        return message.__pydantic_serializer__.to_json(message)  # `model_dump_json` decodes it
    return message.SerializeToString()


@functools.cache
def channel_of(topic: Topic, kind: type[Event | Protobuf]) -> tuple[Schema, Channel]:
    """The schema of a kind of message and the channel of its topic, both under the topic's number."""
    number = NUMBERS[topic]
    if issubclass(kind, Event):
        encoding, data = "json", json.dumps(kind.model_json_schema(), sort_keys=True).encode()
        schema = Schema(id=number, name=f"brushloop.{kind.__name__}", encoding="jsonschema", data=data)
    else:
        from mcap_protobuf.schema import build_file_descriptor_set

        encoding, data = "protobuf", build_file_descriptor_set(kind).SerializeToString()
        schema = Schema(id=number, name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=data)
    return schema, Channel(number, str(topic), encoding, {}, number)


class McapWriter:
    """Writes one file, from its header to `finish`. What is buffered reaches the file with `flush`. Never fsyncs."""

    def __init__(self, file: IO[bytes], header: Header) -> None:
        self._file = file
        self._compressor = zstandard.ZstdCompressor(level=1)  # smaller here than level 3, and faster
        self._records = bytearray()
        """Records of the chunk in progress."""
        self._index: defaultdict[int, list[int]] = defaultdict(list)
        """Log time and offset of each message of that chunk, one after the other, by channel."""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[mcap.AttachmentIndex] = []
        self._counts: Counter[int] = Counter()
        self._crc = 0
        """Of everything written to the file so far."""
        self._write(MCAP0_MAGIC)
        self._write(_packed(mcap.Header(profile="", library=header.software)))
        self.add_attachment(HEADER_FILE, header.model_dump_json().encode())

    def add_attachment(self, name: str, data: bytes) -> None:
        """Write an attached file, JSON or TOML."""
        offset, media_type = self._file.tell(), f"application/{Path(name).suffix[1:]}"
        length = self._write(_packed(mcap.Attachment(0, 0, name, media_type, data)))
        self._attachments.append(mcap.AttachmentIndex(offset, length, 0, 0, len(data), name, media_type))

    def add_channel(self, schema: Schema | None, channel: Channel) -> None:
        """Put a channel and its schema into the chunk in progress; their numbers must be free."""
        if schema is not None:
            self._records += _packed(schema)
            self.schemas[schema.id] = schema
        self._records += _packed(channel)
        self.channels[channel.id] = channel

    def add_message(self, channel_id: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message to the chunk in progress."""
        records = self._records
        self._index[channel_id] += (log_ns, len(records))
        size = MESSAGE_START.size - RECORD_START.size + len(data)
        records += MESSAGE_START.pack(Opcode.MESSAGE, size, channel_id, sequence, log_ns, publish_ns)
        records += data
        if len(records) > CHUNK_BYTES:
            self._end_chunk()

    def record(self, outgoing: Outgoing) -> None:
        """Encode a message and add it; the first on a topic with its schema, which is then flushed."""
        number = NUMBERS[outgoing.topic]
        if outgoing.topic == Topic.STEP:  # in a chunk of its own: damage elsewhere does not hide a step
            self.flush()
        new = number not in self.channels
        if new:
            self.add_channel(*channel_of(outgoing.topic, type(outgoing.message)))
        data = encoded(outgoing.message)
        self.add_message(number, outgoing.sequence, outgoing.log_ns, outgoing.publish_ns, data)
        if new or outgoing.topic in (Topic.STEP, Topic.STROKE):  # a damaged chunk costs at most one stroke
            self.flush()

    def copy(self, schema: Schema | None, channel: Channel, message: Message) -> None:
        """Add a message of another file as it is; all copied messages are of one file."""
        if channel.id not in self.channels:
            self.add_channel(schema, channel)
        self.add_message(channel.id, message.sequence, message.log_time, message.publish_time, message.data)
        if channel.topic == Topic.STROKE:
            self.flush()

    def copy_file(self, path: Path) -> None:
        """Add all chunks of a file of the same session as they are, every CRC checked. Raises `SessionDamaged`."""
        source = McapFile(path, check=True).sound()
        for number, (schema, channel) in source.channels.items():
            if number not in self.channels:
                self.add_channel(schema, channel)
            elif self.channels[number].topic != channel.topic:
                raise SessionDamaged(path, f"gives {channel.topic} the channel number of {self.channels[number].topic}")
        self._end_chunk()
        for data, index in source.packed_chunks():
            shift = self._file.tell() - index.chunk_start_offset
            self._write(data)
            offsets = {number: at + shift for number, at in index.message_index_offsets.items()}
            start = index.chunk_start_offset + shift
            self._chunks.append(replace(index, chunk_start_offset=start, message_index_offsets=offsets))
        for number, (_schema, channel) in source.channels.items():
            self._counts[number] += source.counts[channel.topic]

    def flush(self) -> None:
        """End the chunk in progress unless it has no messages, and hand everything to the operating system."""
        self._end_chunk()
        self._file.flush()

    def finish(self) -> None:
        """End the chunk in progress and write the index. The file stays open."""
        self._end_chunk()
        self._write(_packed(mcap.DataEnd(self._crc)))
        start = self._file.tell()
        statistics = mcap.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=0,
            schema_count=len(self.schemas),
        )
        summary: list[McapRecord] = [*self.schemas.values(), *self.channels.values(), statistics]
        summary += [*self._chunks, *self._attachments]
        data = b"".join(map(_packed, summary))
        footer = _packed(mcap.Footer(start, 0, 0))[:-4]  # its CRC covers all but itself
        self._write(data)
        self._write(_packed(mcap.Footer(start, 0, zlib.crc32(footer, zlib.crc32(data)))))
        self._write(MCAP0_MAGIC)

    def _end_chunk(self) -> None:
        if not self._index:
            return  # schemas and channels wait for their first message
        start, records = self._file.tell(), self._records
        first_ns = min(min(index[::2]) for index in self._index.values())
        last_ns = max(max(index[::2]) for index in self._index.values())
        packed = self._compressor.compress(records)
        chunk = _packed(mcap.Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(records), len(records)))
        length = self._write(chunk)
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


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


@contextlib.contextmanager
def new_mcap(path: Path, header: Header, attachments: Mapping[str, bytes]) -> Generator[McapWriter]:
    """A new file to copy messages into; finished and durable after the block. Raises `OSError`."""
    with path.open("xb") as file:
        writer = McapWriter(file, header)
        for name, data in attachments.items():
            writer.add_attachment(name, data)
        yield writer
        writer.finish()
        sync(file)


class SegmentWriter:
    """Writes `<name>.mcap.part`, then renames it to `<name>.mcap`.

    Raises `SessionError` where either file exists: recordings are never overwritten.
    """

    def __init__(self, final: Path, header: Header) -> None:
        self.final = final
        self._part = final.with_name(final.name + ".part")
        self._header = header
        self._queue: queue.SimpleQueue[Outgoing | None] = queue.SimpleQueue()
        self._error: Exception | None = None
        self.counts: Counter[str] = Counter()
        """Messages by topic, those in the queue among them."""
        try:
            if final.exists():
                raise FileExistsError
            self._file = self._part.open("xb")
        except FileExistsError:
            raise SessionError(final, "exists already; recordings are never overwritten") from None
        except OSError as error:
            raise disk_error(self._part, "cannot create", error) from error
        self._thread = threading.Thread(target=self._run, name=f"writer {final.name}")
        self._thread.start()

    def write(self, outgoing: Outgoing) -> None:
        """Queue a message. Raises `SessionError` for a disk that failed or is too slow."""
        self._raise_error()
        if self._queue.qsize() >= QUEUE_LIMIT:
            raise SessionError(self._part, f"{QUEUE_LIMIT} messages wait to be written: the disk does not keep up")
        self.counts[outgoing.topic] += 1
        self._queue.put(outgoing)

    def finish(self) -> str:
        """Drain, finish, fsync, rename, fsync the folder, and return the file's digest.

        Raises `SessionError`; the part file then stays.
        """
        self.abandon()
        self._raise_error()
        try:
            sha256 = file_sha256(self._part)
            self._part.rename(self.final)
            fsync_folder(self.final.parent)
        except OSError as error:
            raise disk_error(self._part, "cannot finish", error) from error
        return sha256

    def abandon(self) -> None:
        """End the thread; without `finish` the part file is kept as evidence of an interrupted step."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise disk_error(self._part, "cannot write", self._error) from self._error

    def _run(self) -> None:
        try:
            with self._file:
                self._write_all()
                sync(self._file)
        except Exception as error:
            self._error = error

    def _write_all(self) -> None:
        writer = McapWriter(self._file, self._header)
        writer.flush()
        flushed = time.monotonic()
        while True:
            with contextlib.suppress(queue.Empty):
                if (outgoing := self._queue.get(timeout=FLUSH_S)) is None:
                    break
                writer.record(outgoing)
            if time.monotonic() - flushed > FLUSH_S:
                writer.flush()
                flushed = time.monotonic()
        writer.finish()
