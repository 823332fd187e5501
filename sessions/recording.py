"""A session's one MCAP file: reading its header and its strokes with their stills, and merging the steps into it.

Photographs are read one at a time.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.sessions.disk import (
    MAX_SNAPSHOT_BYTES,
    SNAPSHOT_NAMES,
    check_companions,
    file_sha256,
    fsync_folder,
    read_bounded,
    set_aside,
)
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, disk_error, in_one_line
from brushloop.sessions.folders import check_name, not_a_session
from brushloop.sessions.history import remarks_of
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.mcap_file import McapFile, Part, Record, open_mcap, scan
from brushloop.sessions.mcap_writer import new_mcap
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.records import REPAIRS_NOTE, Event, Header, StepEvent, Stroke, Topic
from brushloop.sessions.run_state import RunState

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_E = TypeVar("_E", bound=Event)
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


class Recording:
    """One finished recording, opened by its folder or its MCAP file."""

    def __init__(self, path: Path) -> None:
        self.path = _find_mcap(path)
        self._file = open_mcap(self.path)
        self.header = parse_header(self._file)

    @property
    def sha256(self) -> str:
        """Digest of the MCAP file, for provenance."""
        return file_sha256(self.path)

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic according to the index, without reading them."""
        return self._file.stated

    def attachment(self, name: str) -> bytes:
        """File attached to the recording (`rig.toml`). Raises `InputError` where there is none."""
        for attachment in self._file.attachments():
            if attachment.name == name and len(attachment.data) <= MAX_ATTACHMENT_BYTES:
                return attachment.data
        raise InputError(self.path, f"holds no {name} of at most {MAX_ATTACHMENT_BYTES} bytes")

    def strokes(self) -> int:
        """Number of strokes according to the index, without reading them."""
        return self.counts.get(Topic.STROKE, 0)

    def stroke_records(self) -> Iterator[Stroke]:
        """Strokes as they were commanded, without their stills. Raises `SessionDamaged`."""
        return self.events(Topic.STROKE, Stroke)

    def events(self, topic: Topic, kind: type[_E]) -> Iterator[_E]:
        """Events on a topic, in the order in which they were written. Raises `SessionDamaged`."""
        for _schema, _channel, message in self.messages(topic):
            yield _event(self.path, kind, message.data)

    def captures(self) -> Iterator[Capture]:
        """Strokes with their stills, in order of capture. Raises `SessionDamaged`."""
        return self._captures(self.messages(Topic.STILL, Topic.STROKE), self.marked_bad())

    def capture(self, number: int, bad: dict[int, str]) -> Capture:
        """The capture of one stroke, counted from 0, read without the others; `bad` as from `marked_bad`.

        Raises `SessionDamaged` also for a recording whose strokes do not have a chunk each, as they do in ours.
        """
        before, parts = 0, list[Part]()
        for part in self._file.parts:
            if before == number:
                parts.append(part)
            before += self._file.may_hold(part, (Topic.STROKE,))
        found = list(self._captures(self._file.messages([Topic.STILL, Topic.STROKE], parts), bad))
        if before != self.strokes() or len(found) != 1:
            raise SessionDamaged(self.path, f"stroke number {number} cannot be read alone")
        return found[0]

    def marked_bad(self) -> dict[int, str]:
        """Reasons why captures were marked bad, by number of the still. Raises `SessionDamaged`."""
        latest = remarks_of(self.path.parent).values()
        return {one.still: f"was marked bad{f': {one.note}' if one.note else ''}" for one in latest if one.bad}

    def stills_of(self, kind: str) -> Iterator[bytes]:
        """Encoded stills taken in steps of this kind (`board`)."""
        current = ""
        for _schema, channel, message in self.messages(Topic.STEP, Topic.STILL):
            if channel.topic == Topic.STEP:
                event = _event(self.path, StepEvent, message.data)
                current = event.kind if event.phase == "begin" else ""
            elif current == kind:
                yield _still(self.path, message.data)

    def messages(self, *topics: Topic) -> Iterator[Record]:
        """Messages on these topics, in the order in which they were written. Raises `SessionDamaged`."""
        return self._file.messages(topics)

    def _captures(self, messages: Iterable[Record], bad: dict[int, str]) -> Iterator[Capture]:
        """Strokes with their stills, from messages on both topics."""
        stills: OrderedDict[int, bytes] = OrderedDict()
        for _schema, channel, message in messages:
            if channel.topic == Topic.STILL:
                stills[message.sequence] = _still(self.path, message.data)
                while len(stills) > STILLS_KEPT:
                    stills.popitem(last=False)
                continue
            stroke = _event(self.path, Stroke, message.data)
            if stroke.still not in stills:
                raise SessionDamaged(
                    self.path, f"stroke {stroke.stroke_id} names still {stroke.still}, which is not there"
                )
            where = f"{self.path} stroke {stroke.stroke_id}"
            yield Capture(stroke, stills[stroke.still], where, bad.get(stroke.still, ""))


def _find_mcap(path: Path) -> Path:
    check_name(path)
    if path.is_file():
        check_companions(path.parent)
        return path
    if not path.is_dir():
        raise not_a_session(path)
    merged = path / f"{path.resolve().name}.mcap"
    if (path / JOURNAL_NAME).is_file() and replay(path / JOURNAL_NAME).is_open:
        raise InputError(path, "is still open: run the same `brushloop collect` again to finish it")
    if not merged.is_file():
        raise not_a_session(path)
    return merged


def parse_header(file: McapFile) -> Header:
    """Header of a file; its CRC is not checked. Raises `InputError` where it has none, `SessionDamaged`."""
    if file.header is None:
        raise InputError(file.path, "is an MCAP file without brushloop's header")
    try:
        return Header.model_validate(file.header, strict=False)
    except ValidationError as error:
        raise SessionDamaged(file.path, _first_error(Header, error)) from None


def _still(path: Path, data: bytes) -> bytes:
    try:
        return decode_still(data)
    except DecodeError as error:
        raise SessionDamaged(path, f"a still cannot be read: {in_one_line(error)}") from None


def _event(path: Path, kind: type[_E], data: bytes) -> _E:
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        raise SessionDamaged(path, _first_error(kind, error)) from None


def _first_error(kind: type[Event], error: ValidationError) -> str:
    first = error.errors()[0]
    field = ".".join(str(part) for part in first["loc"])
    return " ".join(f"{kind.__name__}.{field}: {first['msg']}".split())


def count_messages(path: Path) -> dict[str, int]:
    """Number of messages by topic in a file whose every CRC is right. Raises `SessionDamaged`."""
    found = scan(path)
    if found.damage:
        raise SessionDamaged(path, "; ".join(found.damage))
    return dict(found.counts)


def merge_session(folder: Path, state: RunState, header: Header, tag: str = "superseded") -> Path:
    """Merge the finished steps of a session into its one MCAP file, in the order of the journal.

    The file includes the configuration and a note of any repairs, so that it can be shared alone. It gets its name
    once it was read back with correct CRCs and the journal's counts. A file of that name, left by an interrupted close,
    is kept beside it under `tag`. Raises `SessionDamaged` naming the step that cannot be read, or the wrong counts, and
    for a sound file of that name with messages that the steps do not have.
    """
    final = folder / f"{folder.name}.mcap"
    if final.exists():
        _check_not_emptier(final, state, header)
        set_aside(final, tag)
    part = final.with_name(final.name + ".part")
    expected = state.counts()
    try:
        part.unlink(missing_ok=True)  # only a copy of steps that still exist
        repairs = [repair.model_dump(mode="json") for repair in state.repairs]
        notes = {REPAIRS_NOTE: {"repairs": repairs}} if repairs else {}
        snapshots = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
        attachments = {path.name: read_bounded(path, MAX_SNAPSHOT_BYTES) for path in snapshots}
        with new_mcap(part, header, notes, attachments) as writer:
            for file in state.files:
                writer.copy_file(folder / file)
        counts = count_messages(part)
        if counts != expected:
            raise SessionDamaged(part, f"holds {counts}, but the journal says {expected}")
        part.rename(final)
        fsync_folder(final.parent)
    except OSError as error:
        raise disk_error(part, "cannot write", error) from error
    return final


def _check_not_emptier(final: Path, state: RunState, header: Header) -> None:
    try:
        more = Counter(count_messages(final)) - Counter(state.counts())
    except SessionError:
        return
    if more and McapFile(final).session == header.session_id:
        raise SessionDamaged(final, f"holds {more.total()} messages that the steps in the journal do not have")
