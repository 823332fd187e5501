"""Reading MCAP files that a crash, a bad disk or a stranger may have changed.

Records are read by the mcap library, which believes the lengths that a file states and meets damage with a dozen kinds
of error. Here every length is bounded before anything is unpacked, every CRC is checked, and damage is a
`SessionDamaged` that names the file. `scan` reads what is intact in a damaged file.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import zstandard
from mcap.data_stream import ReadDataStream
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
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.records import HEADER_METADATA, Topic, header_crc, read_note, session_in

MAX_RECORD_BYTES = 512 * 1024 * 1024
"""Largest record, chunk or index that is read: a chunk is 512 KiB plus one message, the largest image allowed."""
RECORD_START = struct.Struct("<BQ")
"""Opcode, and length of what follows."""
MESSAGE_START = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the data follow."""
_IN_CHUNK = struct.Struct("<BQH")
"""Opcode and length of a record in a chunk, and the channel if it is a message."""
_OTHERS = (ValueError, RuntimeError, LookupError, ArithmeticError, EOFError, OSError)
UNREADABLE = (McapError, struct.error, zstandard.ZstdError, *_OTHERS)
"""Everything that mcap, zstd and the system raised in tests with damaged files.

Not `MemoryError`: too little memory says nothing about a file. Lengths are bounded before anything is read.
"""

Record = tuple[Schema | None, Channel, Message]
Channels = dict[int, tuple[Schema | None, Channel]]
_T = TypeVar("_T")


class McapFile:
    """A finished file, by the index at its end. Raises `InputError` for other files, `SessionDamaged` for damage."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.summary = next(self._guarded(lambda file: iter([_summary(file)])))

    @property
    def channels(self) -> Channels:
        """The channels by number, each with its schema."""
        return _channels(self.summary)

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic according to the index, without reading them."""
        return _stated(self.summary)

    def messages(
        self, topics: Iterable[str] | None = None, chunks: Iterable[ChunkIndex] | None = None
    ) -> Iterator[Record]:
        """Messages in the order in which they were written, all or those on some topics, every CRC checked.

        They are not sorted by log time: a stroke would precede its still if the host's clock was set back between them.
        `chunks` are those to read, all by default.
        """
        wanted = None if topics is None else set(topics)
        channels = self.channels

        def read(file: IO[bytes]) -> Iterator[Record]:
            if not self.summary.chunk_indexes and self.counts:
                raise McapError("has messages outside chunks, which no CRC protects")
            for index in self.chunks(wanted) if chunks is None else chunks:
                for message in _messages(_chunk(file, index.chunk_start_offset), channels):
                    if wanted is None or channels[message.channel_id][1].topic in wanted:
                        yield *channels[message.channel_id], message

        return self._guarded(read)

    def chunks(self, topics: Iterable[str] | None = None) -> list[ChunkIndex]:
        """The chunks that may hold messages on some topics, in the order in which they were written."""
        chunks = sorted(self.summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
        return chunks if topics is None else [chunk for chunk in chunks if self.may_hold(chunk, set(topics))]

    def may_hold(self, chunk: ChunkIndex, topics: Container[str]) -> bool:
        """Whether a chunk holds messages on any of these topics; True also where its index does not say."""
        channels = self.summary.channels
        numbers = chunk.message_index_offsets
        return not numbers or any(number in channels and channels[number].topic in topics for number in numbers)

    def packed_chunks(self) -> Iterator[tuple[bytes, ChunkIndex, Counter[int]]]:
        """Every chunk as its bytes, with the indexes of its messages, and its messages by channel; CRCs are checked."""

        def read(file: IO[bytes]) -> Iterator[tuple[bytes, ChunkIndex, Counter[int]]]:
            for index in self.chunks():
                counts, _records = _counted(_chunk(file, index.chunk_start_offset))
                size = index.chunk_length + index.message_index_length
                if not counts.keys() <= self.summary.channels.keys() or size > os.fstat(file.fileno()).st_size:
                    raise McapError("a chunk is not as the index states")
                file.seek(index.chunk_start_offset)
                yield file.read(size), index, counts

        return self._guarded(read)

    def metadata(self) -> Iterator[Metadata]:
        """Metadata records."""
        return self._guarded(lambda file: (_metadata(file, one.offset) for one in self.summary.metadata_indexes))

    def attachments(self) -> Iterator[Attachment]:
        """Attached files, byte for byte."""
        return self._guarded(lambda file: (_attachment(file, one.offset) for one in self.summary.attachment_indexes))

    def _guarded(self, read: Callable[[IO[bytes]], Iterator[_T]]) -> Generator[_T]:
        """Yield items; turn the library's exceptions into `SessionDamaged`, not those of the code that uses an item."""
        with opened(self.path) as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise InputError(self.path, "is not an MCAP file")
            items: Iterator[_T] | None = None
            while True:
                try:
                    items = items or read(file)
                    item = next(items)
                except StopIteration:
                    return
                except UNREADABLE as error:
                    raise SessionDamaged(self.path, f"cannot read: {in_one_line(error)}") from None
                yield item


def opened(path: Path) -> IO[bytes]:
    """Open a recording. Raises `InputError`."""
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(path, f"cannot open: {in_one_line(error)}") from None


def _summary(file: IO[bytes]) -> Summary:
    """The index of a file, its CRC checked: otherwise one wrong bit in it could silently hide strokes."""
    tail = FOOTER_SIZE + len(MCAP0_MAGIC)
    footer_at = os.fstat(file.fileno()).st_size - tail
    file.seek(max(footer_at, 0))
    footer = file.read(tail)
    start, crc = struct.unpack_from("<9xQ8xI", footer)
    if not footer.endswith(MCAP0_MAGIC) or not 0 < start <= footer_at:
        raise McapError("has no index: it was not finished, or is cut short")
    file.seek(start)
    data = file.read(MAX_RECORD_BYTES)
    if zlib.crc32(data[: -len(MCAP0_MAGIC) - 4]) != crc:
        raise McapError("the index does not match its CRC")
    summary = Summary()
    for record in StreamReader(io.BytesIO(data), skip_magic=True).records:
        match record:
            case Statistics():
                summary.statistics = record
            case Schema():
                summary.schemas[record.id] = record
            case Channel():
                summary.channels[record.id] = record
            case ChunkIndex():
                summary.chunk_indexes.append(record)
            case AttachmentIndex():
                summary.attachment_indexes.append(record)
            case MetadataIndex():
                summary.metadata_indexes.append(record)
            case _:
                pass
    if summary.statistics is None:
        raise McapError("has no index: it was not finished")
    return summary


def _channels(summary: Summary) -> Channels:
    return {n: (summary.schemas.get(channel.schema_id), channel) for n, channel in summary.channels.items()}


def _stated(summary: Summary) -> dict[str, int]:
    counts = cast("Statistics", summary.statistics).channel_message_counts
    return {summary.channels[key].topic: count for key, count in counts.items() if key in summary.channels}


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _record(file: IO[bytes], offset: int, opcode: Opcode) -> bytes:
    """Content of the record at this place. Raises any of `UNREADABLE`."""
    file.seek(offset)
    actual, length = RECORD_START.unpack(file.read(RECORD_START.size))
    if actual != opcode or length > min(MAX_RECORD_BYTES, os.fstat(file.fileno()).st_size - file.tell()):
        raise McapError(f"no {opcode.name.lower()} of at most {MAX_RECORD_BYTES} bytes is at byte {offset}")
    return file.read(length)


def _metadata(file: IO[bytes], offset: int) -> Metadata:
    return Metadata.read(_stream(_record(file, offset, Opcode.METADATA)))


def _attachment(file: IO[bytes], offset: int) -> Attachment:
    data = _record(file, offset, Opcode.ATTACHMENT)
    if zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        raise McapError("an attachment does not match its CRC")
    return Attachment.read(_stream(data))


def _chunk(file: IO[bytes], offset: int) -> bytes:
    """Records of a chunk, unpacked and checked against its CRC. Raises any of `UNREADABLE`."""
    chunk = Chunk.read(_stream(_record(file, offset, Opcode.CHUNK)))
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, zstandard.frame_content_size(chunk.data))
    elif chunk.compression:
        raise McapError(f"chunk compressed by {chunk.compression!r}, allowed: zstd or none")
    if size > MAX_RECORD_BYTES:
        raise McapError(f"chunk of {size} bytes exceeds {MAX_RECORD_BYTES}")
    if not chunk.uncompressed_crc:
        raise McapError("chunk without a CRC")
    try:
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    except zstandard.ZstdError as error:
        if "not enough memory" in str(error):
            raise MemoryError from None
        raise
    return stream.read(size)


def _counted(records: bytes) -> tuple[Counter[int], list[Schema | Channel]]:
    """Messages of a chunk by channel, and its schemas and channels. Raises any of `UNREADABLE`."""
    counts: defaultdict[int, int] = defaultdict(int)
    others: list[Schema | Channel] = []
    at, size, unpack, message = 0, len(records), _IN_CHUNK.unpack_from, int(Opcode.MESSAGE)
    while at < size:
        opcode, length, channel = unpack(records, at)
        if opcode == message:
            counts[channel] += 1
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            body = _stream(records[at + RECORD_START.size : at + RECORD_START.size + length])
            others.append(Schema.read(body) if opcode == Opcode.SCHEMA else Channel.read(body))
        at += 9 + length
    if at != size:
        raise McapError("a record is longer than its chunk")
    return Counter(counts), others


def _messages(records: bytes, known: Mapping[int, object]) -> Iterator[Message]:
    """Messages of a chunk, in order. Raises any of `UNREADABLE`, also for a channel that is not `known`."""
    at = 0
    while at < len(records):
        opcode, length = RECORD_START.unpack_from(records, at)
        end = at + RECORD_START.size + length
        if opcode == Opcode.MESSAGE:
            _, _, channel, sequence, log_ns, publish_ns = MESSAGE_START.unpack_from(records, at)
            if channel not in known:
                raise McapError("a chunk has messages of a channel that the index does not list")
            yield Message(channel, log_ns, records[at + MESSAGE_START.size : end], publish_ns, sequence)
        at = end


@dataclass(frozen=True, slots=True)
class Part:
    """One chunk of a file, readable or not."""

    offset: int
    counts: Counter[str] | None
    """Number of messages by topic; None for a chunk that cannot be read or does not match its CRC."""

    @property
    def sound(self) -> bool:
        """Whether it can be read and matches its CRC."""
        return self.counts is not None


@dataclass(slots=True)
class Scan:
    """What is intact in a file, and what is wrong with the rest."""

    path: Path
    parts: list[Part] = field(default_factory=list[Part])
    """Known chunks, in order."""
    complete: bool = False
    """Whether all chunks are known: the walk reached the end, or the index is intact."""
    channels: Channels = field(default_factory=dict[int, tuple[Schema | None, Channel]])
    notes: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    """Our own notes (`brushloop.begin`, ...) that match their CRC."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    """All metadata."""
    attachments: list[Attachment] = field(default_factory=list[Attachment])
    counts: Counter[str] = field(default_factory=Counter[str])
    """Messages by topic in the sound chunks."""
    index: Summary | None = None
    """None if it is damaged."""
    damage: list[str] = field(default_factory=list[str])
    """Descriptions of the damage; empty for an intact file."""

    @property
    def stated(self) -> dict[str, int] | None:
        """Number of messages by topic according to the index; None if it is damaged."""
        return None if self.index is None else _stated(self.index)

    @property
    def session(self) -> str:
        """Id of the session whose header the file holds; empty where it holds none that matches its CRC."""
        return session_in(self.metadata.get(HEADER_METADATA, {}))

    def messages(self, parts: Iterable[Part] | None = None, topics: Container[str] = tuple(Topic)) -> Iterator[Record]:
        """Messages of the sound chunks, or of these, in the order in which they were written. Raises `OSError`."""
        with self.path.open("rb") as file:
            for part in self.parts if parts is None else parts:
                if part.counts is not None and any(topic in topics for topic in part.counts):
                    for message in _messages(_chunk(file, part.offset), self.channels):
                        schema, channel = self.channels[message.channel_id]
                        if channel.topic in topics:
                            yield schema, channel, message


def scan(path: Path, *, read_chunks: bool = True) -> Scan:
    """Read a file once: every CRC is checked and messages are counted, none is decoded.

    A file that is cut or damaged is read record by record as far as that goes; the index at its end, if it is intact,
    gives the places of the rest. Raises `InputError` where it cannot be opened; damage is reported, never raised.
    """
    found = Scan(path)
    with opened(path) as file:
        try:
            places = dict(_walk(file, found)) | _listed(file, found)
            for offset in sorted(places):
                if read_chunks or places[offset] in (Opcode.METADATA, Opcode.ATTACHMENT):
                    _read_part(file, found, offset, places[offset])
        except OSError as error:
            found.damage.append(f"cannot be read: {in_one_line(error)}")
    if read_chunks and not found.damage and found.stated != dict(found.counts):
        found.damage.append(f"holds {dict(found.counts)}, but its index says {found.stated}")
    return found


def _walk(file: IO[bytes], found: Scan) -> Iterator[tuple[int, int]]:
    """Places and opcodes of the records, up to the end of the data or to the first that cannot be read."""
    size = os.fstat(file.fileno()).st_size
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        found.damage.append("does not begin as an MCAP file does")
    at = len(MCAP0_MAGIC)
    while True:
        file.seek(at)
        start = file.read(RECORD_START.size)
        if len(start) < RECORD_START.size:
            found.damage.append(f"ends at byte {size} without an index")
            return
        opcode, length = RECORD_START.unpack(start)
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END:
            found.damage.append(f"no record can be read at byte {at}")
            return
        if at + RECORD_START.size + length > size:
            found.damage.append(f"is cut short in the record at byte {at}")
            return
        if opcode in (Opcode.CHUNK, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.DATA_END):
            yield at, opcode
        if opcode == Opcode.DATA_END:
            found.complete = True
            return
        at += RECORD_START.size + length


def _listed(file: IO[bytes], found: Scan) -> dict[int, int]:
    """Places and opcodes of the records that the index lists, whose channels a lost chunk may have held."""
    try:
        summary = _summary(file)
    except UNREADABLE as error:
        found.damage.append(f"its index cannot be read ({in_one_line(error)})")
        return {}
    found.index, found.channels, found.complete = summary, _channels(summary), True
    places = {one.chunk_start_offset: int(Opcode.CHUNK) for one in summary.chunk_indexes}
    places |= {one.offset: int(Opcode.METADATA) for one in summary.metadata_indexes}
    return places | {one.offset: int(Opcode.ATTACHMENT) for one in summary.attachment_indexes}


def _read_part(file: IO[bytes], found: Scan, offset: int, opcode: int) -> None:
    """Add a record to what was found, or its damage."""
    try:
        if opcode == Opcode.METADATA:
            _add_metadata(_metadata(file, offset), found)
        elif opcode == Opcode.ATTACHMENT:
            found.attachments.append(_attachment(file, offset))
        elif opcode == Opcode.DATA_END:
            if not found.damage:
                _check_data(file, offset)
        else:
            by_number, others = _counted(_chunk(file, offset))
            schemas = {one.id: one for one in others if isinstance(one, Schema)}
            for one in others:
                if isinstance(one, Channel):
                    found.channels.setdefault(one.id, (schemas.get(one.schema_id), one))
            counts = Counter({found.channels[number][1].topic: count for number, count in by_number.items()})
            found.counts += counts
            found.parts.append(Part(offset, counts))
    except UNREADABLE as error:
        name = Opcode(opcode).name.lower()
        found.damage.append(f"the {name} at byte {offset} cannot be read ({in_one_line(error)})")
        if opcode == Opcode.CHUNK:
            found.parts.append(Part(offset, None))


def _check_data(file: IO[bytes], end: int) -> None:
    """Check the CRC of everything before the mark `end`, also of what no other CRC protects."""
    (expected,) = struct.unpack("<I", _record(file, end, Opcode.DATA_END))
    file.seek(0)
    crc = at = 0
    while at < end:
        piece = file.read(min(end - at, 1 << 20))
        crc, at = zlib.crc32(piece, crc), at + len(piece)
    if expected not in (0, crc):
        raise McapError("what is before it does not match its CRC")


def _add_metadata(record: Metadata, found: Scan) -> None:
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
