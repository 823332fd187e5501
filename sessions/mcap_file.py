"""Reading MCAP files that a crash, a bad disk or a stranger may have changed.

Records are read by the mcap library, which believes the lengths that a file states and meets damage with a dozen kinds
of error. Here every length is bounded before anything is unpacked, every CRC is checked, and damage is named.
"""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, SeekingReader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.records import HEADER_FILE

MAX_RECORD_BYTES = 512 * 1024 * 1024
"""Largest record, chunk or index that is read: a chunk is 512 KiB plus one message, the largest image allowed."""
RECORD_START = struct.Struct("<BQ")
"""Opcode, and length of what follows."""
MESSAGE_START = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the data follow."""
_NOT_MCAP = "is not an MCAP file by its first bytes"
_OTHERS = (ValueError, RuntimeError, LookupError, ArithmeticError, EOFError, OSError)
UNREADABLE = (McapError, struct.error, zstandard.ZstdError, *_OTHERS)
"""Everything that mcap, zstd and the system raised in tests with damaged files.

Not `MemoryError`: too little memory says nothing about a file. Lengths are bounded before anything is read.
"""

Record = tuple[Schema | None, Channel, Message]


class McapFile:
    """A file by the index at its end, or, where that is damaged, record by record as far as that goes.

    With `check` all of it is read once, every CRC is checked, and messages are counted; none is decoded. Raises
    `InputError` where it cannot be opened; damage is collected in `damage`.
    """

    def __init__(self, path: Path, *, check: bool = False) -> None:
        self.path = path
        self.damage: list[str] = []
        """Descriptions of what is damaged, as far as it was read."""
        self.index: Summary | None = None
        """None if it is damaged."""
        self._chunks: dict[int, ChunkIndex | None] = {}
        """Known chunks by their place, in the order in which they were written, if all was checked only the sound ones;
        None without an index."""
        self.counts: Counter[str] = Counter()
        """Messages by topic in the sound chunks, if all was checked."""
        self.channels: dict[int, tuple[Schema | None, Channel]] = {}
        """Channels by number, each with its schema; without an index those of the sound chunks, if all was checked."""
        self.header: dict[str, Any] | None = None
        """Values of the header, also where they do not match their CRC; None for a file without a header."""
        self.session = ""
        """Id of the session of a header that matches its CRC; empty where none does."""
        self._attached: list[int] = []
        with opened(path) as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                self.damage.append(_NOT_MCAP)
            with self._noting("its index"):
                self.index = _summary(file)
            self._list(file)
            if check:
                self._check(file)

    def sound(self) -> McapFile:
        """The file itself. Raises `InputError` if it is none of MCAP, `SessionDamaged` if anything is damaged."""
        if self.damage[:1] == [_NOT_MCAP]:
            raise InputError(self.path, f"{_NOT_MCAP}: give a session's folder or its .mcap file")
        if self.damage:
            raise SessionDamaged(self.path, f"cannot read: {'; '.join(self.damage)}")
        return self

    @property
    def stated(self) -> Counter[str]:
        """Messages by topic according to the index, without reading them; empty if it is damaged."""
        statistics = None if self.index is None else self.index.statistics
        counts = {} if statistics is None else statistics.channel_message_counts
        return self._by_topic({number: count for number, count in counts.items() if number in self.channels})

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[Record]:
        """Messages in the order in which they were written, all or those on some topics, every CRC checked.

        They are not sorted by log time: a stroke would precede its still if the host's clock was set back between them.
        If all was checked, damaged chunks are left out. Raises `SessionDamaged`.
        """
        wanted = None if topics is None else frozenset(topics)
        numbers = {n for n, (_, channel) in self.channels.items() if wanted is None or channel.topic in wanted}
        with self._reading() as file:
            for offset, index in self._chunks.items():
                inside = {} if index is None else index.message_index_offsets
                if inside and numbers.isdisjoint(inside):
                    continue
                for message in _messages(_chunk(file, offset)):
                    schema, channel = self.channels[message.channel_id]
                    if message.channel_id in numbers:
                        yield schema, channel, message

    def packed_chunks(self) -> Iterator[tuple[bytes, ChunkIndex]]:
        """Every chunk as its bytes, with the indexes of its messages. Raises `SessionDamaged`."""
        with self._reading() as file:
            for offset, index in self._chunks.items():
                size = 0 if index is None else index.chunk_length + index.message_index_length
                if index is None or size > _size(file):
                    raise McapError("a chunk does not match the index")
                file.seek(offset)
                yield file.read(size), index

    def attachments(self) -> Iterator[Attachment]:
        """Attached files, byte for byte; if all was checked, but those that are damaged. Raises `SessionDamaged`."""
        with self._reading() as file:
            for offset in self._attached:
                yield _attachment(file, offset)

    def _check(self, file: IO[bytes]) -> None:
        attached, self._attached = self._attached, []
        chunks, self._chunks = self._chunks, {}
        for offset, index in chunks.items():
            with self._noting(f"the chunk at byte {offset}"):
                self.counts += self._by_topic(self._read_chunk(file, offset))
                self._chunks[offset] = index
        for offset in attached:
            with self._noting(f"the attachment at byte {offset}"):
                _attachment(file, offset)
                self._attached.append(offset)
        if not self.damage:
            with self._noting("its data"):
                _check_data(file)
        if not self.damage and self.stated != self.counts:
            self.damage.append(f"holds {dict(self.counts)}, but its index says {dict(self.stated)}")

    def _list(self, file: IO[bytes]) -> None:
        """Take over what the index lists, whose channels a lost chunk may have held; without one, look for it."""
        if (index := self.index) is None:
            self._walk(file)
            return
        self.channels = {n: (index.schemas.get(one.schema_id), one) for n, one in index.channels.items()}
        chunks = {one.chunk_start_offset: one for one in index.chunk_indexes}
        self._chunks = {offset: chunks[offset] for offset in sorted(chunks)}
        for one in index.attachment_indexes:
            self._attach(file, one.offset, one.name)
        if not chunks and self.stated:
            self.damage.append("has messages outside chunks, which no CRC protects")

    def _walk(self, file: IO[bytes]) -> None:
        """Find the records up to the end of the data or to the first that cannot be read."""
        at = len(MCAP0_MAGIC)
        while True:
            file.seek(at)
            start = file.read(RECORD_START.size)
            opcode, length = RECORD_START.unpack(start) if len(start) == RECORD_START.size else (0, 0)
            if opcode == Opcode.DATA_END:
                return
            if not Opcode.HEADER <= opcode < Opcode.DATA_END or length > _size(file) - file.tell():
                self.damage.append(f"no whole record can be read at byte {at}")
                return
            if opcode == Opcode.CHUNK:
                self._chunks[at] = None
            elif opcode == Opcode.ATTACHMENT:
                self._attach(file, at)
            at += RECORD_START.size + length

    def _read_chunk(self, file: IO[bytes], offset: int) -> Counter[int]:
        """Messages of a chunk by channel; its channels become known. Raises any of `UNREADABLE`."""
        records = _chunk(file, offset)
        counts: defaultdict[int, int] = defaultdict(int)
        schemas: dict[int, Schema] = {}
        message = int(Opcode.MESSAGE)  # a member of an enum takes half of the time
        for opcode, start, end in _records(records):
            if opcode == message:
                counts[records[start] | records[start + 1] << 8] += 1
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(records[start:end]))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(records[start:end]))
                self.channels.setdefault(channel.id, (schemas.get(channel.schema_id), channel))
        return Counter(counts)

    def _by_topic(self, counts: Mapping[int, int]) -> Counter[str]:
        by_topic: Counter[str] = Counter()
        for number, count in counts.items():
            by_topic[self.channels[number][1].topic] += count
        return by_topic

    def _attach(self, file: IO[bytes], offset: int, name: str = HEADER_FILE) -> None:
        """Take over an attachment; if it is the header, read it."""
        self._attached.append(offset)
        if name == HEADER_FILE:
            with self._noting(f"the attachment at byte {offset}"):
                attached = Attachment.read(_stream(_record(file, offset, Opcode.ATTACHMENT)))
                if attached.name == HEADER_FILE:
                    self.header = json.loads(attached.data)
                    _attachment(file, offset)
                    self.session = str((self.header or {})["session_id"])

    @contextmanager
    def _noting(self, what: str) -> Generator[None]:
        """Within the block, what cannot be read is damage."""
        try:
            yield
        except UNREADABLE as error:
            self.damage.append(f"{what} cannot be read ({in_one_line(error)})")

    @contextmanager
    def _reading(self) -> Generator[IO[bytes]]:
        """The file, open within the block; what cannot be read in it is `SessionDamaged`."""
        with opened(self.path) as file:
            try:
                yield file
            except UNREADABLE as error:
                raise SessionDamaged(self.path, f"cannot read: {in_one_line(error)}") from None


def opened(path: Path) -> IO[bytes]:
    """Open a recording. Raises `InputError`."""
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(path, f"cannot open: {in_one_line(error)}") from None


def _summary(file: IO[bytes]) -> Summary:
    """The index of a file. Raises any of `UNREADABLE`.

    Its CRC is checked: otherwise one wrong bit in it could silently hide strokes.
    """
    start, footer_at, crc = _footer(file)
    file.seek(start)
    if zlib.crc32(file.read(min(footer_at + FOOTER_SIZE - 4 - start, MAX_RECORD_BYTES))) != crc:
        raise McapError("the index does not match its CRC")
    file.seek(0)
    summary = SeekingReader(file, record_size_limit=MAX_RECORD_BYTES).get_summary()
    if summary is None or summary.statistics is None:
        raise McapError("has no index: it was not finished")
    return summary


def _footer(file: IO[bytes]) -> tuple[int, int, int]:
    """Where the index and the footer begin, and the CRC of the index. Raises any of `UNREADABLE`."""
    tail = FOOTER_SIZE + len(MCAP0_MAGIC)
    footer_at = _size(file) - tail
    file.seek(max(footer_at, 0))
    footer = file.read(tail)
    start, crc = struct.unpack_from("<9xQ8xI", footer)
    if not footer.endswith(MCAP0_MAGIC) or not 0 < start <= footer_at:
        raise McapError("has no index: it was not finished, or is cut short")
    return start, footer_at, crc


def _check_data(file: IO[bytes]) -> None:
    """Check the CRC of everything before the index, also of what no other CRC protects.

    The library's reader of whole files does so too, but believes the lengths that stand in the chunks.
    """
    end = _footer(file)[0] - RECORD_START.size - 4
    expected = int.from_bytes(_record(file, end, Opcode.DATA_END), "little")
    file.seek(0)
    crc = 0
    while data := file.read(min(end - file.tell(), 1 << 20)):
        crc = zlib.crc32(data, crc)
    if expected not in (0, crc):
        raise McapError("the data section does not match its CRC")


def _size(file: IO[bytes]) -> int:
    return os.fstat(file.fileno()).st_size


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _record(file: IO[bytes], offset: int, opcode: Opcode) -> bytes:
    """Content of the record at this place. Raises any of `UNREADABLE`."""
    file.seek(offset)
    actual, length = RECORD_START.unpack(file.read(RECORD_START.size))
    if actual != opcode or length > min(MAX_RECORD_BYTES, _size(file) - file.tell()):
        raise McapError(f"the {opcode.name.lower()} at byte {offset} is missing, or exceeds {MAX_RECORD_BYTES} bytes")
    return file.read(length)


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


def _records(chunk: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode of each record of a chunk, and where its content begins and ends. Raises any of `UNREADABLE`."""
    end, size, unpack = 0, len(chunk), RECORD_START.unpack_from
    while end < size:
        opcode, length = unpack(chunk, end)
        start = end + 9
        end = start + length
        yield opcode, start, end
    if end != size:
        raise McapError("a record is longer than its chunk")


def _messages(chunk: bytes) -> Iterator[Message]:
    """Messages of a chunk, in order. Raises any of `UNREADABLE`."""
    for opcode, start, end in _records(chunk):
        if opcode == Opcode.MESSAGE:
            at = start - RECORD_START.size
            _, _, channel, sequence, log_ns, publish_ns = MESSAGE_START.unpack_from(chunk, at)
            yield Message(channel, log_ns, chunk[at + MESSAGE_START.size : end], publish_ns, sequence)
