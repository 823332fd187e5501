"""Reading a recording: its header, and its strokes with their stills one at a time, in constant memory."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.folders import check_name, not_a_session
from brushloop.sessions.journal.journal import JOURNAL_NAME, is_open, replay
from brushloop.sessions.names import check_companions
from brushloop.sessions.recording import container
from brushloop.sessions.recording.mcap_file import HEADER_METADATA, file_sha256, header_crc
from brushloop.sessions.recording.messages import decode_gray, decode_still
from brushloop.sessions.recording.schemas import Event, Header, StepEvent, Stroke, Topic
from brushloop.sessions.remarks import remarks_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_ATTACHMENT_BYTES = 1024 * 1024
STILLS_KEPT = 8
"""Stills kept in memory: a stroke refers to one shortly before it, so older ones can be dropped."""


@dataclass(frozen=True, slots=True)
class Capture:
    """Stroke and the still that shows it."""

    stroke: Stroke
    still_png: bytes
    where: str
    bad: str = ""
    """Reason given by the person who marked it bad; empty if it was not marked."""

    def image(self) -> NDArray[np.uint8]:
        """(h, w) uint8 gray. Raises `SessionDamaged` naming the stroke."""
        return decode_gray(self.still_png, self.where)


@dataclass(frozen=True, slots=True)
class Place:
    """Where a stroke and its still lie in a recording, so that they can be read without the rest."""

    stroke_id: str
    offsets: tuple[int, ...]
    """Chunks to read."""
    topics: dict[int, str]
    bad: str = ""
    """See `Capture`."""


class Recording:
    """One finished recording, opened by its folder or its MCAP file."""

    def __init__(self, path: Path) -> None:
        self.path = _find_mcap(path)
        self.header = _read_header(self.path)

    @property
    def sha256(self) -> str:
        """Digest of the MCAP file, for provenance."""
        return file_sha256(self.path)

    def attachment(self, name: str) -> bytes:
        """File attached to the recording (`rig.toml`). Raises `InputError` where there is none."""
        for attachment in container.attachments(self.path):
            if attachment.name == name and len(attachment.data) <= MAX_ATTACHMENT_BYTES:
                return attachment.data
        raise InputError(self.path, f"holds no {name} of at most {MAX_ATTACHMENT_BYTES} bytes")

    def strokes(self) -> int:
        """Number of strokes according to the index, without reading them."""
        return container.indexed_counts(self.path).get(Topic.STROKE, 0)

    def stroke_records(self) -> Iterator[Stroke]:
        """Strokes as they were commanded, without their stills. Raises `SessionDamaged`."""
        for _topic, _sequence, data in self._messages([Topic.STROKE]):
            yield _event(self.path, Stroke, data)

    def captures(self) -> Iterator[Capture]:
        """Strokes with their stills, in order of capture. Raises `SessionDamaged`."""
        return _captures(self.path, self._messages([Topic.STILL, Topic.STROKE]), self.marked_bad())

    def places(self) -> Iterator[Place]:
        """Where each stroke lies, in order of capture, without reading a still. Raises `SessionDamaged`."""
        bad = self.marked_bad()
        for offsets, topics, message in container.chunks_before(self.path, Topic.STROKE, [Topic.STILL]):
            stroke = _event(self.path, Stroke, message.data)
            yield Place(stroke.stroke_id, offsets, topics, bad.get(stroke.still, ""))

    def marked_bad(self) -> dict[int, str]:
        """Reasons why captures were marked bad, by number of the still. Raises `SessionDamaged`."""
        latest = remarks_of(self.path.parent).values()
        return {one.still: f"was marked bad{f': {one.note}' if one.note else ''}" for one in latest if one.bad}

    def stills_of(self, kind: str) -> Iterator[bytes]:
        """Encoded stills taken in steps of this kind (`board`)."""
        current = ""
        for topic, _sequence, data in self._messages([Topic.STEP, Topic.STILL]):
            if topic == Topic.STEP:
                event = _event(self.path, StepEvent, data)
                current = event.kind if event.phase == "begin" else ""
            elif current == kind:
                yield _still(self.path, data)

    def _messages(self, topics: list[Topic]) -> Iterator[tuple[str, int, bytes]]:
        for _schema, channel, message in container.messages(self.path, [str(topic) for topic in topics]):
            yield channel.topic, message.sequence, message.data


def capture_at(path: Path, place: Place) -> Capture:
    """The stroke at a place of the recording `path`, with its still. Raises `SessionDamaged` if they are not there."""
    found = ((topic, one.sequence, one.data) for topic, one in container.messages_at(path, place.offsets, place.topics))
    for capture in _captures(path, found, {}):
        if capture.stroke.stroke_id == place.stroke_id:
            return replace(capture, bad=place.bad)
    raise SessionDamaged(path, f"stroke {place.stroke_id} is not where the index says")


def _captures(path: Path, messages: Iterator[tuple[str, int, bytes]], bad: dict[int, str]) -> Iterator[Capture]:
    """Strokes with their stills, from messages on both topics."""
    stills: OrderedDict[int, bytes] = OrderedDict()
    for topic, sequence, data in messages:
        if topic == Topic.STILL:
            stills[sequence] = _still(path, data)
            while len(stills) > STILLS_KEPT:
                stills.popitem(last=False)
            continue
        stroke = _event(path, Stroke, data)
        if stroke.still not in stills:
            raise SessionDamaged(path, f"stroke {stroke.stroke_id} names still {stroke.still}, which is not there")
        where = f"{path} stroke {stroke.stroke_id}"
        yield Capture(stroke, stills[stroke.still], where, bad.get(stroke.still, ""))


def _find_mcap(path: Path) -> Path:
    check_name(path)
    if path.is_file():
        check_companions(path.parent)
        return path
    if not path.is_dir():
        raise not_a_session(path)
    merged = path / f"{path.resolve().name}.mcap"
    if (path / JOURNAL_NAME).is_file() and is_open(replay(path / JOURNAL_NAME)):
        raise InputError(path, "is still open: run the same `brushloop collect` again to finish it")
    if not merged.is_file():
        raise not_a_session(path)
    return merged


def _read_header(path: Path) -> Header:
    for record in container.metadata(path):
        if record.name == HEADER_METADATA:
            if record.metadata.get("crc", header_crc(record.metadata)) != header_crc(record.metadata):
                raise SessionDamaged(path, "header does not match its CRC")
            return parse_header(path, record.metadata)
    raise InputError(path, "is an MCAP file without brushloop's header")


def parse_header(path: Path, metadata: dict[str, str]) -> Header:
    """Header from its metadata record; its CRC is not checked. Raises `SessionDamaged`."""
    try:
        values: dict[str, Any] = {name: json.loads(text) for name, text in metadata.items() if name != "crc"}
        return Header.model_validate(values, strict=False)
    except ValidationError as error:
        raise SessionDamaged(path, _first_error(Header, error)) from None
    except (ValueError, RecursionError) as error:
        raise SessionDamaged(path, f"header cannot be read: {in_one_line(error)}") from None


def _still(path: Path, data: bytes) -> bytes:
    try:
        return decode_still(data)
    except DecodeError as error:
        raise SessionDamaged(path, f"a still cannot be read: {in_one_line(error)}") from None


_E = TypeVar("_E", Stroke, StepEvent)


def _event(path: Path, kind: type[_E], data: bytes) -> _E:
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        raise SessionDamaged(path, _first_error(kind, error)) from None


def _first_error(kind: type[Event], error: ValidationError) -> str:
    first = error.errors()[0]
    field = ".".join(str(part) for part in first["loc"])
    return " ".join(f"{kind.__name__}.{field}: {first['msg']}".split())
