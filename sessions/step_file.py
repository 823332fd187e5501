"""The MCAP file of one step, written by a thread of its own from a queue; durable when `finish` returns.

A kill -9 loses at most the last 250 ms of a step, and that step is done again anyway.
"""

from __future__ import annotations

import json
import queue
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcap.records import Channel, Schema

from brushloop.sessions.disk import file_sha256, fsync_folder, sync
from brushloop.sessions.errors import SessionError, disk_error
from brushloop.sessions.mcap_writer import McapWriter, start_mcap
from brushloop.sessions.records import BEGIN_NOTE, DONE_NOTE, Event, Header, Recorded, Topic, note

if TYPE_CHECKING:
    from google.protobuf.message import Message

FLUSH_S = 0.25
WAIT_S = 0.001
"""Between two looks at a full queue."""
QUEUE_LIMIT = 20_000
"""Queue size, about 200 s of poses: a full queue means that the disk does not keep up, which is an error."""


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message on its way to the writer thread."""

    topic: Topic
    log_ns: int
    publish_ns: int
    sequence: int
    message: Event | Message


class SegmentWriter:
    """Writes `<name>.mcap.part`, then renames it to `<name>.mcap`.

    `begun` is stored inside as metadata, so that a lost journal can be rebuilt from the files. Raises `SessionError`
    where either file exists: recordings are never overwritten.
    """

    def __init__(
        self, final: Path, header: Header, queue_limit: int = QUEUE_LIMIT, begun: dict[str, Any] | None = None
    ) -> None:
        self.final = final
        self._part = final.with_name(final.name + ".part")
        self._header = header
        self._queue: queue.SimpleQueue[Outgoing | None] = queue.SimpleQueue()
        self._queue_limit = queue_limit
        self._begun = begun
        self._finished: dict[str, Any] | None = None
        self._error: Exception | None = None
        self._ended = False
        """Set by the thread once it has taken the end mark, the last item, off the queue."""
        self.counts: Counter[str] = Counter()
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

    def write(self, outgoing: Outgoing, wait_s: float = 0.0) -> None:
        """Queue a message, waiting at most `wait_s`. Raises `SessionError` for a disk that failed or is too slow."""
        self._raise_error()
        deadline = time.monotonic() + wait_s
        while self._queue.qsize() >= self._queue_limit:
            if time.monotonic() >= deadline:
                raise SessionError(self._part, f"{self._queue_limit} messages wait: the disk does not keep up")
            time.sleep(WAIT_S)
        self._queue.put(outgoing)

    def finish(self, finished: dict[str, Any] | None = None) -> Recorded:
        """Drain, finish, fsync, rename, fsync the folder. Raises `SessionError`; the part file then stays.

        `finished` is stored inside as metadata, with the counts of messages.
        """
        self._finished = finished
        self._join()
        self._raise_error()
        try:
            recorded = Recorded(dict(self.counts), file_sha256(self._part), self._part.stat().st_size)
            self._part.rename(self.final)
            fsync_folder(self.final.parent)
        except OSError as error:
            raise disk_error(self._part, "cannot finish", error) from error
        return recorded

    def abandon(self) -> None:
        """End the thread and keep the part file as evidence of an interrupted step."""
        self._join()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise disk_error(self._part, "cannot write", self._error) from self._error

    def _join(self) -> None:
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _run(self) -> None:
        try:
            with self._file:
                self._write_all()
                sync(self._file)
        except Exception as error:
            self._error = error
            while not self._ended:  # the caller must not block on a thread that failed
                self._ended = self._queue.get() is None

    def _write_all(self) -> None:
        notes = {} if self._begun is None else {BEGIN_NOTE: self._begun}
        writer = start_mcap(self._file, self._header, notes, {})
        if self._begun is not None:
            writer.flush()
        channels = ChannelTable(writer)
        flushed = time.monotonic()
        while True:
            try:
                outgoing = self._queue.get(timeout=FLUSH_S)
            except queue.Empty:
                writer.flush()
                flushed = time.monotonic()
                continue
            if outgoing is None:
                self._ended = True
                break
            channels.add(outgoing)
            if time.monotonic() - flushed > FLUSH_S:
                writer.flush()
                flushed = time.monotonic()
        writer.flush()
        self.counts = writer.counts
        if self._finished is not None:
            writer.add_metadata(DONE_NOTE, note({**self._finished, "counts": dict(self.counts)}))
        writer.finish()


def encoded(message: Event | Message) -> bytes:
    """The message as it is recorded: an event as JSON, anything else as protobuf."""
    if isinstance(message, Event):
        return message.__pydantic_serializer__.to_json(message)  # `model_dump_json` decodes it
    return message.SerializeToString()


class ChannelTable:
    """Adds a channel at the first message on a topic, and flushes so that its schema is on disk.

    A topic has the same number in every file, so that a merge can copy chunks as they are.
    """

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._numbers: dict[str, int] = {}

    def add(self, outgoing: Outgoing) -> None:
        """Encode and write one message."""
        number = self._numbers.get(outgoing.topic)
        new = number is None
        if number is None:
            number = self._numbers[outgoing.topic] = list(Topic).index(outgoing.topic) + 1
            self._writer.add_channel(*_channel(number, outgoing))
        self._writer.add_message(
            channel_id=number,
            log_time=outgoing.log_ns,
            publish_time=outgoing.publish_ns,
            sequence=outgoing.sequence,
            data=encoded(outgoing.message),
        )
        if new or outgoing.topic == Topic.STROKE:  # ends the chunk, so that a damaged chunk costs one stroke
            self._writer.flush()


def _channel(number: int, outgoing: Outgoing) -> tuple[Schema, Channel]:
    """The channel of a topic and its schema, both under this number."""
    message = outgoing.message
    if isinstance(message, Event):
        data = json.dumps(type(message).model_json_schema(), sort_keys=True).encode()
        schema = Schema(id=number, name=f"brushloop.{type(message).__name__}", encoding="jsonschema", data=data)
    else:
        from mcap_protobuf.schema import build_file_descriptor_set

        data = build_file_descriptor_set(type(message)).SerializeToString()
        schema = Schema(id=number, name=message.DESCRIPTOR.full_name, encoding="protobuf", data=data)
    encoding = "json" if isinstance(message, Event) else "protobuf"
    return schema, Channel(number, str(outgoing.topic), encoding, {}, number)
