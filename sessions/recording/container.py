"""Reading MCAP files that a crash, a bad disk or a stranger may have changed.

The mcap library meets damage with a dozen kinds of error. Here the index is checked by its CRC (`index.py`), and damage
is a `SessionDamaged` that names the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.recording.chunk import Contents
from brushloop.sessions.recording.index import UNREADABLE, BoundedFile, Index, chunk_at, indexed, opened, record_at

Record = tuple[Schema | None, Channel, Message]
_T = TypeVar("_T")


def messages(path: Path, topics: list[str] | None = None) -> Iterator[Record]:
    """Messages in the order in which they were written, every CRC checked. Raises `SessionDamaged`.

    They are not sorted by log time: a stroke would precede its still if the host's clock was set back between the two.
    """
    return _guarded(path, lambda file: _messages(file, topics))


def messages_at(path: Path, offsets: Sequence[int], topics: Mapping[int, str]) -> Iterator[tuple[str, Message]]:
    """Yield (topic, message) from the chunks at `offsets`; the index is not read. Raises `SessionDamaged`.

    `topics` gives the topic of each wanted channel by the channel's number.
    """

    def read(file: BoundedFile) -> Iterator[tuple[str, Message]]:
        for offset in offsets:
            for message in chunk_at(file, offset).each(topics):
                yield topics[message.channel_id], message

    return _guarded(path, read)


def chunks_before(
    path: Path, last: str, kept: Sequence[str]
) -> Iterator[tuple[tuple[int, ...], dict[int, str], Message]]:
    """Yield (offsets, topics, message) for each message on the topic `last`, ready for `messages_at`.

    The offsets are those of its chunk, and of the chunks since the previous message on `last` that hold messages on
    `kept`. Raises `SessionDamaged`.
    """

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


def _guarded(path: Path, read: Callable[[BoundedFile], Iterator[_T]]) -> Iterator[_T]:
    """Yield items; turn the library's exceptions into `SessionDamaged`, but not those of the code that uses an item."""
    with opened(path) as file:
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


def _metadata(file: BoundedFile) -> Iterator[Metadata]:
    for one in indexed(file).metadata:
        record = record_at(file, one.offset)
        if not isinstance(record, Metadata):
            raise McapError("the index names metadata where there is none")
        yield record


def _attachments(file: BoundedFile) -> Iterator[Attachment]:
    for one in indexed(file).attachments:
        record = record_at(file, one.offset)
        if not isinstance(record, Attachment):
            raise McapError("the index names an attachment where there is none")
        again = RecordBuilder()
        record.write(again)
        file.seek(one.offset)
        if file.read(one.length) != again.end():  # the reader skips the CRC of an attachment
            raise McapError(f"attachment {record.name!r} does not match its CRC")
        yield record


def _indexed_counts(file: BoundedFile) -> Iterator[dict[str, int]]:
    index = indexed(file)
    counts = index.statistics.channel_message_counts
    yield {index.channels[channel_id].topic: count for channel_id, count in counts.items()}
