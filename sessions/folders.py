"""Session folders: find those that are open, choose a free name, and report one that was renamed."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

from brushloop.sessions.disk import SEGMENT_NAME, check_folder
from brushloop.sessions.errors import InputError, SessionError
from brushloop.sessions.journal import JOURNAL_NAME, replay


def check_name(folder: Path) -> None:
    """Raise `InputError`, with advice, for a folder that was renamed or holds links, and for an unfinished file."""
    if folder.suffix == ".part" and folder.is_file():
        what = "was never finished, because a step or a merge was cut: it is kept as evidence and is not a recording"
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
    """Return the only recording in a folder if its name differs from the folder's; None otherwise.

    Also None for an open session, which may be renamed: the files of its steps do not carry its name.
    """
    name = folder.resolve().name
    recordings = [path for path in folder.glob("*.mcap") if not SEGMENT_NAME.fullmatch(path.name)]
    if (folder / f"{name}.mcap").exists() or len(recordings) != 1 or _is_open(folder):
        return None
    return recordings[0]


def not_a_session(folder: Path) -> InputError:
    """Make the error for a path without a recording; the message says what to give instead."""
    if not folder.is_dir():
        return InputError(folder, "no such session: give a session's folder or its .mcap file")
    name = f"{folder.resolve().name}.mcap"
    if (folder / JOURNAL_NAME).is_file():
        return InputError(folder, f"has lost its recording {name}: `brushloop sessions repair {folder}` makes it again")
    inside = sorted(path for path in folder.iterdir() if (path / JOURNAL_NAME).is_file() or any(path.glob("*.mcap")))
    if inside:
        return InputError(folder, f"is not a session but holds {len(inside)} of them: give one, such as {inside[0]}")
    return InputError(folder, f"is not a session: it holds neither {JOURNAL_NAME} nor a recording {name}")


def _is_open(folder: Path) -> bool:
    try:
        return (folder / JOURNAL_NAME).is_file() and replay(folder / JOURNAL_NAME).is_open
    except SessionError:
        return False


def next_session_id(root: Path, label: str, today: dt.date) -> str:
    """Return `2026-11-21-grid-01` with the first number that is free under `root`."""
    for number in range(1, 1000):
        session_id = f"{today.isoformat()}-{label}-{number:02d}"
        if not (root / session_id).exists():
            return session_id
    raise InputError(root, f"has 999 sessions of {today.isoformat()}-{label}")


def open_sessions(root: Path) -> list[Path]:
    """Folders under `root` whose journal was opened and has no `closed` event, oldest first.

    A session that is damaged or holds links is left out, so that it stands in no other's way.
    """
    found: list[Path] = []
    for journal in sorted(root.glob(f"*/{JOURNAL_NAME}")):
        try:
            check_folder(journal.parent)
            if replay(journal).is_open:
                found.append(journal.parent)
        except SessionError:
            continue
    return found
