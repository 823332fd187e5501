"""Merging the steps of a session into one file when it closes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from brushloop.sessions.disk import MAX_SNAPSHOT_BYTES, fsync_folder, read_bounded, set_aside
from brushloop.sessions.errors import SessionDamaged, SessionError, disk_error
from brushloop.sessions.journal.journal import Replay
from brushloop.sessions.names import SNAPSHOT_NAMES
from brushloop.sessions.recording.mcap_file import count_messages, new_mcap
from brushloop.sessions.recording.salvage import session_of
from brushloop.sessions.recording.schemas import Header

REPAIRS_NOTE = "brushloop.repairs"
"""Note in a merged file whose session was repaired: what was rewritten, what is missing, and what was lost."""


def merge_session(folder: Path, state: Replay, header: Header, tag: str = "superseded") -> Path:
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
        notes = {REPAIRS_NOTE: {"repairs": list(state.repairs)}} if state.repairs else {}
        snapshots = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
        attachments = {path.name: read_bounded(path, MAX_SNAPSHOT_BYTES) for path in snapshots}
        with new_mcap(part, header, notes, attachments) as copy:
            for line in state.segments:
                copy.add_file(folder / str(line["file"]))
        counts = count_messages(part)
        if counts != expected:
            raise SessionDamaged(part, f"holds {counts}, but the journal says {expected}")
        part.rename(final)
        fsync_folder(final.parent)
    except OSError as error:
        raise disk_error(part, "cannot write", error) from error
    return final


def _check_not_emptier(final: Path, state: Replay, header: Header) -> None:
    try:
        more = Counter(count_messages(final)) - Counter(state.counts())
    except SessionError:
        return
    if more and session_of(final) == header.session_id:
        raise SessionDamaged(final, f"holds {more.total()} messages that the steps in the journal do not have")
