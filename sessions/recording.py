"""A session's recording: its header, its strokes with their stills, and what is known of each capture besides.

Remarks (bad, good again, a note) are added to captures afterwards. `remarks.jsonl` holds one line per remark, with a
CRC as in the journal; the latest remark on a still counts. The recording itself is never changed, so that a closed
session stays byte for byte as recorded. Photographs are read one at a time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pydantic import ValidationError

from brushloop.sessions.disk import SEGMENT_NAME, check_companions, check_folder, file_sha256
from brushloop.sessions.errors import InputError, SessionDamaged, in_one_line
from brushloop.sessions.events import Begin, Remark, StepEvent
from brushloop.sessions.journal import JOURNAL_NAME, Journal, RunState, replay, undamaged
from brushloop.sessions.mcap_file import McapFile, Record
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.records import Event, Header, Stroke, Topic

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_E = TypeVar("_E", bound=Event)
REMARKS_NAME = "remarks.jsonl"
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
        check_path(path)
        if path.is_file():
            check_companions(path.parent)
        state = replay(path / JOURNAL_NAME) if (path / JOURNAL_NAME).is_file() else None
        if state is not None and state.is_open:
            raise InputError(path, "is still open: run the same `brushloop collect` again to finish it")
        self.path = find_recording(path, state)
        self._file = McapFile(self.path).sound()
        self.header = parse_header(self._file)

    @cached_property
    def sha256(self) -> str:
        """Digest of the MCAP file, for provenance; read once."""
        return file_sha256(self.path)

    @property
    def counts(self) -> Counter[str]:
        """Messages by topic according to the index, without reading them."""
        return self._file.stated

    def attachment(self, name: str) -> bytes:
        """File attached to the recording (`rig.toml`). Raises `InputError` where there is none."""
        for attachment in self._file.attachments():
            if attachment.name == name and len(attachment.data) <= MAX_ATTACHMENT_BYTES:
                return attachment.data
        raise InputError(self.path, f"{name} is missing, or larger than {MAX_ATTACHMENT_BYTES} bytes")

    def stroke_records(self) -> Iterator[Stroke]:
        """Strokes as they were commanded, without their stills. Raises `SessionDamaged`."""
        return self.events(Topic.STROKE, Stroke)

    def events(self, topic: Topic, kind: type[_E]) -> Iterator[_E]:
        """Events on a topic, in the order in which they were written. Raises `SessionDamaged`."""
        for _schema, _channel, message in self.messages(topic):
            yield _event(self.path, kind, message.data)

    def captures(self) -> Iterator[Capture]:
        """Strokes with their stills, in order of capture. Raises `SessionDamaged`."""
        bad = bad_stills(self.path.parent)
        latest: deque[tuple[int, bytes]] = deque(maxlen=STILLS_KEPT)
        for _schema, channel, message in self.messages(Topic.STILL, Topic.STROKE):
            if channel.topic == Topic.STILL:
                latest.append((message.sequence, decode_still(message.data, self.path)))
                continue
            stroke = _event(self.path, Stroke, message.data)
            if (still := dict(latest).get(stroke.still)) is None:
                what = f"stroke {stroke.stroke_id} refers to photograph {stroke.still}, which is missing"
                raise SessionDamaged(self.path, what)
            yield Capture(stroke, still, f"{self.path} stroke {stroke.stroke_id}", bad.get(stroke.still, ""))

    def stills_of(self, kind: str) -> Iterator[tuple[int, bytes]]:
        """Time in ns and encoded still, in order, of those taken in steps of this kind (`board`)."""
        current = ""
        for _schema, channel, message in self.messages(Topic.STEP, Topic.STILL):
            if channel.topic == Topic.STEP:
                step = _event(self.path, StepEvent, message.data).step
                current = step.kind if isinstance(step, Begin) else ""
            elif current == kind:
                yield message.log_time, decode_still(message.data, self.path)

    def messages(self, *topics: Topic) -> Iterator[Record]:
        """Messages on these topics, in the order in which they were written. Raises `SessionDamaged`."""
        return self._file.messages(topics)


def merged_file(folder: Path, state: RunState | None = None) -> Path:
    """Where a session's one recording is: it is named after the session, whatever the folder is called now.

    `state` is that of its journal; without one, the only recording in the folder is the session's.
    """
    if state is not None and state.opened is not None:
        return folder / f"{state.opened.header.session_id}.mcap"
    recordings = [path for path in folder.glob("*.mcap") if not SEGMENT_NAME.fullmatch(path.name)]
    return recordings[0] if len(recordings) == 1 else folder / f"{folder.resolve().name}.mcap"


def find_recording(path: Path, state: RunState | None = None) -> Path:
    """The MCAP file that a path names, or that of a session's folder.

    Raises `InputError` where there is none; the message says what to give instead.
    """
    found = merged_file(path, state) if path.is_dir() else path
    if found.is_file():
        return found
    if not path.is_dir():
        raise InputError(path, "no such session: give a session's folder or its .mcap file")
    if (path / JOURNAL_NAME).is_file():
        raise InputError(path, f"has lost its recording {found.name}: `brushloop sessions repair {path}` rebuilds it")
    inside = sorted(one for one in path.iterdir() if (one / JOURNAL_NAME).is_file() or any(one.glob("*.mcap")))
    if inside:
        raise InputError(path, f"is not a session but holds {len(inside)} of them: give one, such as {inside[0]}")
    raise InputError(path, f"is not a session: it holds neither {JOURNAL_NAME} nor a recording {found.name}")


def check_path(path: Path) -> None:
    """Raise `InputError` for a folder that holds links, and, with advice, for an unfinished file."""
    if path.suffix == ".part" and path.is_file():
        what = "is unfinished, as a step or a merge was interrupted: it is kept as evidence and is not a recording"
        raise InputError(path, f"{what}. Give the session's folder, {path.parent}")
    if path.is_dir():
        check_folder(path)


def parse_header(file: McapFile) -> Header:
    """Header of a file; its CRC is not checked. Raises `InputError` where it has none, `SessionDamaged`."""
    if file.header is None:
        raise InputError(file.path, "is an MCAP file without brushloop's header")
    try:
        return Header.model_validate(file.header, strict=False)
    except ValidationError as error:
        raise SessionDamaged(file.path, in_one_line(error)) from None


def _event(path: Path, kind: type[_E], data: bytes) -> _E:
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        raise SessionDamaged(path, in_one_line(error)) from None


def add_remark(folder: Path, remark: Remark) -> None:
    """Append a remark and wait until it is on disk. Raises `SessionError` where that fails."""
    journal = Journal(folder / REMARKS_NAME)
    try:
        journal.append(remark)
    finally:
        journal.close()


def mark_bad_or_good(folder: Path, still: int, stroke_id: str, t_ns: int) -> bool:
    """Switch a capture between bad and good, keep its note, and return whether it is bad now. Raises `SessionError`."""
    known = remarks_of(folder).get(still)
    bad, note = (True, "") if known is None else (not known.bad, known.note)
    add_remark(folder, Remark(t_ns=t_ns, still=still, stroke_id=stroke_id, bad=bad, note=note))
    return bad


def remarks_of(folder: Path) -> dict[int, Remark]:
    """Latest remark for each still; empty where there is none. Raises `SessionDamaged`."""
    path = folder / REMARKS_NAME
    remarks = undamaged(path).events if path.is_file() else []
    return {remark.still: remark for remark in remarks if isinstance(remark, Remark)}


def bad_stills(folder: Path) -> dict[int, str]:
    """Why captures of a session were marked bad, by number of the still. Raises `SessionDamaged`."""
    remarks = (remark for remark in remarks_of(folder).values() if remark.bad)
    return {remark.still: f"was marked bad{f': {remark.note}' if remark.note else ''}" for remark in remarks}
