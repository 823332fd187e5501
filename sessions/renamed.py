"""A session's folder that was renamed: its recording still has the old name, and nothing is damaged."""

from __future__ import annotations

from pathlib import Path

from sessions.errors import InputError, SessionDamaged
from sessions.journal import JOURNAL_NAME, is_open, replay
from sessions.names import check_folder
from sessions.store import SEGMENT_NAME


def check_name(folder: Path) -> None:
    """Raise `InputError` where the folder was renamed, or holds links; says what to do."""
    check_folder(folder)
    recording = recording_of_renamed(folder)
    if recording is not None:
        raise InputError(
            folder,
            f"was renamed: its recording is called {recording.name}. Nothing is damaged by that. Rename the folder "
            f"back to {recording.stem}, or give the file {recording} itself",
        )


def recording_of_renamed(folder: Path) -> Path | None:
    """The one recording in the folder, where it is called otherwise than the folder.

    None for an open session: the files of its steps do not have its name, so it may be renamed.
    """
    name = folder.resolve().name
    recordings = [path for path in folder.glob("*.mcap") if not SEGMENT_NAME.fullmatch(path.name)]
    if (folder / f"{name}.mcap").exists() or len(recordings) != 1 or _is_open(folder):
        return None
    return recordings[0]


def _is_open(folder: Path) -> bool:
    try:
        return (folder / JOURNAL_NAME).is_file() and is_open(replay(folder / JOURNAL_NAME))
    except SessionDamaged:
        return False
