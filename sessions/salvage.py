"""Write what is intact in a damaged file to a new one, which takes its name; the damaged file is kept beside it.

A recording without its session is the only copy: it loses the strokes of its damaged chunks, and nothing else.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from google.protobuf.message import DecodeError
from mcap.records import Message
from pydantic import ValidationError

from brushloop.sessions.disk import fsync_folder, set_aside, sync
from brushloop.sessions.errors import SessionDamaged, disk_error
from brushloop.sessions.journal import Line
from brushloop.sessions.mcap_file import McapFile, Record, scan, scan_sound
from brushloop.sessions.mcap_writer import new_mcap
from brushloop.sessions.messages import decode_still
from brushloop.sessions.recording import parse_header
from brushloop.sessions.records import HEADER_NOTE, Header, StepEvent, Stroke, Topic
from brushloop.sessions.verify import verify_session


@dataclass(slots=True)
class Report:
    """Result of a repair."""

    session: str
    did: list[str] = field(default_factory=list[str])
    lost: list[str] = field(default_factory=list[str])
    """Descriptions of what could not be recovered; empty for a repair without loss."""
    strokes: int = 0
    """Finished strokes in the session after the repair."""

    @property
    def lossless(self) -> bool:
        """Whether everything recorded was recovered."""
        return not self.lost


_E = TypeVar("_E", Stroke, StepEvent)


def parsed(kind: type[_E], message: Message) -> _E | None:
    """The event in a message; None where it does not fit its schema."""
    try:
        return kind.model_validate_json(message.data)
    except ValidationError:
        return None


def write_anew(path: Path, data: bytes) -> str:
    """Replace a file; return the name under which the old one is kept, or an empty string. Raises `OSError`."""
    fresh = path.with_name(path.name + ".repair")
    with fresh.open("wb") as file:
        file.write(data)
        sync(file)
    return _put_in_place(fresh, path)


def _put_in_place(fresh: Path, path: Path) -> str:
    kept = set_aside(path, "damaged").name if path.exists() else ""
    fresh.replace(path)
    fsync_folder(path.parent)
    return kept


def kept_words(name: str) -> str:
    """Say where the damaged file is kept."""
    return f"; the damaged file is kept as {name}" if name else ""


def replace_damaged(
    path: Path, header: Header, notes: dict[str, Line], attachments: dict[str, bytes], messages: Iterable[Record]
) -> tuple[str, dict[str, int]]:
    """Write a file with these contents in place of `path`, and keep the damaged one beside it.

    Returns the name of the damaged file (empty where there was none) and the messages by topic, as read back. Raises
    `SessionError`; the damaged file then still has its own name.
    """
    fresh = path.with_name(path.name + ".repair")
    try:
        fresh.unlink(missing_ok=True)  # left by a killed repair: only a copy
        with new_mcap(fresh, header, notes, attachments) as writer:
            for record in messages:
                writer.copy(*record)
        counts = dict(scan_sound(fresh).counts)
        kept = _put_in_place(fresh, path)
    except OSError as error:
        raise disk_error(path, "cannot write its repaired copy", error) from error
    return kept, counts


class Strokes:
    """Strokes of a damaged file: those recovered with their photographs, each once, and those that are lost."""

    def __init__(self, found: McapFile) -> None:
        self._found = found
        self.kept: dict[str, int] = {}
        """Number of the still that shows it, by name of the stroke."""
        stills, named = set[int](), dict[str, None]()
        for _schema, channel, message in found.messages((Topic.STILL, Topic.STROKE)):
            if channel.topic == Topic.STILL and _shows(message):
                stills.add(message.sequence)
            elif channel.topic == Topic.STROKE and (stroke := parsed(Stroke, message)) is not None:
                named[stroke.stroke_id] = None
                if stroke.still in stills:
                    self.kept.setdefault(stroke.stroke_id, stroke.still)
        self.photograph_lost = [name for name in named if name not in self.kept]

    def messages(self) -> Iterator[Record]:
        """Everything readable, except strokes without a photograph and strokes that were read before."""
        waiting = dict(self.kept)
        for schema, channel, message in self._found.messages():
            stroke = parsed(Stroke, message) if channel.topic == Topic.STROKE else None
            if stroke is not None:
                if waiting.get(stroke.stroke_id) != stroke.still:
                    continue
                del waiting[stroke.stroke_id]
            yield schema, channel, message


def lost_words(strokes: Strokes, before: Counter[str], now: dict[str, int]) -> list[str]:
    """Describe what was lost: each stroke by its name, as far as that can be read, then other messages."""
    lost = [f"stroke {name}: its photograph is lost" for name in strokes.photograph_lost]
    unknown = before[Topic.STROKE] - now.get(Topic.STROKE, 0) - len(lost)
    if unknown > 0:
        lost.append(f"strokes that cannot be read: {unknown}")
    gone = {topic: count - now.get(topic, 0) for topic, count in before.items() if topic != Topic.STROKE}
    return lost + [f"messages on {topic}: {count}" for topic, count in gone.items() if count > 0]


def repair_file(path: Path) -> Report:
    """Repair one MCAP file: an import, or a merged file without its session. Raises `SessionDamaged`."""
    report = Report(path.name)
    verdict = verify_session(path)
    report.strokes = verdict.strokes
    if verdict.sound:
        return report
    found = scan(path)
    if found.header is None:
        raise SessionDamaged(path, "has lost its header; it cannot be repaired")
    header = parse_header(found)
    if HEADER_NOTE not in found.notes:
        report.lost.append("the certainty of its header: it does not match its CRC, and is kept as it was read")
    strokes = Strokes(found)
    notes = {name: values for name, values in found.notes.items() if name != HEADER_NOTE}
    files = {attachment.name: attachment.data for attachment in found.attachments()}
    kept, counts = replace_damaged(path, header, notes, files, strokes.messages())
    why = "; ".join(finding.what for finding in verdict.findings)
    report.did.append(f"wrote {path.name} again from what can be read of it: {why}{kept_words(kept)}")
    report.strokes = counts.get(Topic.STROKE, 0)
    report.lost += lost_words(strokes, Counter(found.stated), counts)
    if found.index is None and len(found.damage) > 1:
        report.lost.append("anything else behind the damage: without its index its amount is unknown")
    if found.index is None:
        return report
    noted = {one.name for one in found.index.metadata_indexes} - {HEADER_NOTE, *found.notes}
    if len(files) < len(found.index.attachment_indexes) or noted:
        report.lost.append("an attached file, or a note of what was done to the recording")
    return report


def _shows(message: Message) -> bool:
    try:
        return bool(decode_still(message.data))
    except DecodeError:
        return False
