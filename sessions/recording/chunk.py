"""What one chunk of an MCAP file holds, unpacked and checked against its CRC."""

from __future__ import annotations

import io
import struct
from collections import defaultdict
from collections.abc import Container, Iterator
from dataclasses import dataclass

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import get_chunk_data_stream

RECORD_START = struct.Struct("<BQ")
"""Opcode, and length of what follows."""
MESSAGE_START = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the data follow."""
_INDEXED = struct.Struct("<BQH4xQ")
"""The same without sequence and publish time."""


@dataclass(frozen=True, slots=True)
class Contents:
    """The records of one chunk."""

    messages: bytes
    """All message records, one behind the other."""
    index: dict[int, list[int]]
    """Log time in ns and offset in `messages` of each message, one after the other, by channel."""
    schemas: list[Schema]
    channels: list[Channel]

    def each(self, channels: Container[int] | None = None) -> Iterator[Message]:
        """Messages in the order in which they were written, or only those of some channels."""
        at = 0
        while at < len(self.messages):
            _, length, channel, sequence, log_ns, publish_ns = MESSAGE_START.unpack_from(self.messages, at)
            end = at + RECORD_START.size + length
            if channels is None or channel in channels:
                data = self.messages[at + MESSAGE_START.size : end]
                yield Message(channel, log_ns, data, publish_ns, sequence)
            at = end


def unpacked(chunk: Chunk) -> Contents:
    """Unpack a chunk. Raises `McapError` for a wrong CRC, `struct.error` for bytes that are not records."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    records = stream.read(size)
    index: defaultdict[int, list[int]] = defaultdict(list)
    schemas: list[Schema] = []
    channels: list[Channel] = []
    pieces: list[bytes] = []
    at = kept = taken_out = 0
    while at < size:
        opcode, length, channel, log_ns = _INDEXED.unpack_from(records, at)
        end = at + RECORD_START.size + length
        if opcode == Opcode.MESSAGE and at + MESSAGE_START.size <= end:
            index[channel] += (log_ns, at - taken_out)
        else:
            body = ReadDataStream(io.BytesIO(records[at + RECORD_START.size : end]))
            if opcode == Opcode.SCHEMA:
                schemas.append(Schema.read(body))
            elif opcode == Opcode.CHANNEL:
                channels.append(Channel.read(body))
            pieces.append(records[kept:at])
            taken_out += end - at
            kept = end
        at = end
    if at != size:
        raise McapError("a record is longer than its chunk")
    return Contents(b"".join([*pieces, records[kept:]]), dict(index), schemas, channels)
