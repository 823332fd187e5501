"""One MCAP file, written by one thread: queue in, file out, durable when `finish` returns.

A kill -9 loses at most the last 250 ms of the step that is done again anyway.
"""

from __future__ import annotations

import hashlib
import os
import queue
import threading
import time
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, cast

from mcap.writer import CompressionType, Writer

from sessions.errors import SessionError, disk_error
from sessions.journal.journal import fsync_folder
from sessions.recording.schemas import Event, Header, Recorded, Topic

if TYPE_CHECKING:
    from google.protobuf.message import Message

CHUNK_BYTES = 256 * 1024
FLUSH_S = 0.25
QUEUE_LIMIT = 20_000
"""About 200 s of poses: more means that the disk does not keep up, and that must be heard."""
HEADER_METADATA = "brushloop.header"
BEGIN_NOTE, DONE_NOTE = "brushloop.begin", "brushloop.done"


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

    `begun` travels inside as a note, so that a lost journal can be rebuilt from the files. Raises `SessionError`
    where either file exists: recordings are never overwritten.
    """

    def __init__(
        self, final: Path, header: Header, queue_limit: int = QUEUE_LIMIT, begun: dict[str, Any] | None = None
    ) -> None:
        self.final = final
        self._part = final.with_name(final.name + ".part")
        self._header = header
        self._queue: queue.Queue[Outgoing | None] = queue.Queue(queue_limit)
        self._begun = begun
        self._finished: dict[str, Any] | None = None
        self._error: Exception | None = None
        self._ended = False
        """Set by the thread once it has taken the end mark off the queue: nothing comes after it."""
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
        """Queue a message, at once or within `wait_s`. Raises `SessionError` for a disk that failed or is too slow."""
        self._raise_error()
        try:
            self._queue.put(outgoing, block=wait_s > 0.0, timeout=wait_s or None)
        except queue.Full:
            raise SessionError(self._part, f"{self._queue.maxsize} messages wait: the disk does not keep up") from None

    def finish(self, finished: dict[str, Any] | None = None) -> Recorded:
        """Drain, finish, fsync, rename, fsync the folder. Raises `SessionError`; the part file then stays.

        `finished` travels inside as a note, with the counts of messages.
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
        """End the thread and leave the part file where it is: a cut step's evidence is kept."""
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
                self._file.flush()
                os.fsync(self._file.fileno())
        except Exception as error:
            self._error = error
            while not self._ended:  # nobody may block on a dead writer
                self._ended = self._queue.get() is None

    def _write_all(self) -> None:
        writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="", library=self._header.software)
        writer.add_metadata(HEADER_METADATA, header_metadata(self._header))
        if self._begun is not None:
            writer.add_metadata(BEGIN_NOTE, note(self._begun))
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
            self.counts[str(outgoing.topic)] += 1
            if time.monotonic() - flushed > FLUSH_S:
                writer.flush()
                flushed = time.monotonic()
        if self._finished is not None:
            writer.add_metadata(DONE_NOTE, note({**self._finished, "counts": dict(self.counts)}))
        writer.finish()


class ChannelTable:
    """Registers a channel the first time a topic is seen, and flushes so that its schema is on disk."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}

    def add(self, outgoing: Outgoing) -> None:
        """Encode and write one message."""
        new = outgoing.topic not in self._channels
        if new:
            self._channels[outgoing.topic] = self._register(outgoing)
        message = outgoing.message
        self._writer.add_message(
            channel_id=self._channels[outgoing.topic],
            log_time=outgoing.log_ns,
            publish_time=outgoing.publish_ns,
            sequence=outgoing.sequence,
            data=message.model_dump_json().encode() if isinstance(message, Event) else message.SerializeToString(),
        )
        if new or outgoing.topic == Topic.STROKE:  # what damages a chunk costs one stroke
            self._writer.flush()

    def _register(self, outgoing: Outgoing) -> int:
        message = outgoing.message
        if isinstance(message, Event):
            import json

            name, encoding = f"brushloop.{type(message).__name__}", "json"
            schema = json.dumps(type(message).model_json_schema(), sort_keys=True).encode()
            schema_encoding = "jsonschema"
        else:
            from mcap_protobuf.schema import build_file_descriptor_set

            name, encoding, schema_encoding = message.DESCRIPTOR.full_name, "protobuf", "protobuf"
            schema = build_file_descriptor_set(type(message)).SerializeToString()
        schema_id = self._writer.register_schema(name=name, encoding=schema_encoding, data=schema)
        return self._writer.register_channel(topic=outgoing.topic, message_encoding=encoding, schema_id=schema_id)


def header_metadata(header: Header) -> dict[str, str]:
    """The header as MCAP metadata: every value JSON, so that it reads back as it was, and a CRC over all of them."""
    import json

    values = {name: json.dumps(value) for name, value in header.model_dump(mode="json").items()}
    return {**values, "crc": header_crc(values)}


def header_crc(values: dict[str, str]) -> str:
    """CRC-32 of a header's metadata, `crc` itself left out."""
    import json

    texts = {name: text for name, text in values.items() if name != "crc"}
    return f"{zlib.crc32(json.dumps(texts, sort_keys=True).encode()):08x}"


def media_type(name: str) -> str:
    """Of a file that travels inside a recording, by the ending of its name."""
    endings = {".toml": "application/toml", ".json": "application/json"}
    return endings.get(PurePath(name).suffix, "application/octet-stream")


def note(values: dict[str, Any]) -> dict[str, str]:
    """Values as MCAP metadata with a CRC of their own: the format gives metadata none."""
    import json

    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    return {"json": text, "crc": f"{zlib.crc32(text.encode()):08x}"}


def read_note(metadata: dict[str, str]) -> dict[str, Any] | None:
    """The values of a note; None where it does not match its CRC. Raises `ValueError` where it is no note."""
    import json

    text = metadata.get("json", "")
    if metadata.get("crc") != f"{zlib.crc32(text.encode()):08x}":
        return None
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("holds no values")
    return cast("dict[str, Any]", values)


def file_sha256(path: Path) -> str:
    """Hex digest of a file, read in pieces."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
