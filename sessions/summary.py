"""What sessions there are under a folder, read from their journals and headers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sessions.errors import InputError, SessionError
from sessions.journal.journal import JOURNAL_NAME, is_open, replay
from sessions.names import check_folder
from sessions.reader import Recording
from sessions.recording.schemas import Source, Topic
from sessions.renamed import recording_of_renamed


@dataclass(frozen=True, slots=True)
class Summary:
    """One session in one line."""

    session_id: str
    state: str
    source: str
    strokes: int
    file: str


def summaries(root: Path) -> Iterator[Summary]:
    """Sessions under `root`, by name; a damaged one is told as such. Raises `InputError` where `root` is no folder."""
    if not root.is_dir():
        raise InputError(root, "is not a folder of sessions")
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        try:
            row = _summary(folder)
        except SessionError as error:
            row = Summary(folder.name, "damaged", "", 0, error.path.name)
        if row is not None:
            yield row


def _summary(folder: Path) -> Summary | None:
    check_folder(folder)
    collected = (folder / JOURNAL_NAME).is_file()
    if collected and is_open(state := replay(folder / JOURNAL_NAME)):
        strokes = sum(line["counts"].get(Topic.STROKE, 0) for line in state.segments)
        return Summary(folder.name, "open", "", strokes, "")
    merged = folder / f"{folder.name}.mcap"
    renamed = None if merged.is_file() else recording_of_renamed(folder)
    if renamed is None and not merged.is_file():
        return None
    recording = Recording(renamed or merged)
    state_name = "imported" if recording.header.source is Source.IMPORT else "closed"
    if renamed is not None:
        return Summary(folder.name, "renamed", recording.header.source, recording.strokes(), renamed.name)
    return Summary(folder.name, state_name, recording.header.source, recording.strokes(), merged.name)
