"""A session's folder that was renamed: its recording still has the old name, and nothing is damaged."""

from __future__ import annotations

from pathlib import Path

from sessions.errors import InputError, SessionDamaged
from sessions.journal.journal import JOURNAL_NAME, is_open, replay
from sessions.names import check_folder
from sessions.store import SEGMENT_NAME


def check_name(folder: Path) -> None:
    """Raise `InputError` for a folder that was renamed or holds links, and for an unfinished file; says what to do."""
    if folder.suffix == ".part" and folder.is_file():
        what = "was never finished, a step or a merge was cut: it is kept as evidence and is no recording"
        raise InputError(folder, f"{what}. Give the session's folder, {folder.parent}")
    if folder.is_dir():
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


def not_a_session(folder: Path) -> InputError:
    """What is wrong with a folder without a recording of its name, and what to give instead."""
    name = f"{folder.resolve().name}.mcap"
    if (folder / JOURNAL_NAME).is_file():
        return InputError(folder, f"has lost its recording {name}: `brushloop sessions repair {folder}` makes it again")
    inside = sorted(path for path in folder.iterdir() if (path / JOURNAL_NAME).is_file() or any(path.glob("*.mcap")))
    if inside:
        return InputError(folder, f"is no session, but holds {len(inside)} of them: give one, as {inside[0]}")
    return InputError(folder, f"is no session: neither {JOURNAL_NAME} nor a recording {name} is in it")


def _is_open(folder: Path) -> bool:
    try:
        return (folder / JOURNAL_NAME).is_file() and is_open(replay(folder / JOURNAL_NAME))
    except SessionDamaged:
        return False
