"""Merging the steps of a session into one file when it closes."""

from __future__ import annotations

from pathlib import Path

from sessions.disk import fsync_folder, set_aside
from sessions.errors import SessionDamaged, disk_error
from sessions.journal.journal import Replay
from sessions.names import SNAPSHOT_NAMES
from sessions.recording.mcap_file import count_messages, new_mcap
from sessions.recording.schemas import Header

REPAIRS_NOTE = "brushloop.repairs"
"""Note in a merged file whose session was repaired: what was rewritten, what is missing, and what was lost."""


def merge_session(folder: Path, state: Replay, header: Header, tag: str = "superseded") -> Path:
    """Merge the finished steps of a session into its one MCAP file, in the order of the journal.

    The file includes the configuration and a note of any repairs, so that it can be shared alone. It gets its name
    once it was read back with correct CRCs and the journal's counts. A file of that name, left by an interrupted close,
    is kept beside it under `tag`. Raises `SessionDamaged` naming the step that cannot be read, or the wrong counts.
    """
    final = folder / f"{folder.name}.mcap"
    if final.exists():
        set_aside(final, tag)
    part = final.with_name(final.name + ".part")
    expected = state.counts()
    try:
        part.unlink(missing_ok=True)  # only a copy of steps that still exist
        notes = {REPAIRS_NOTE: {"repairs": list(state.repairs)}} if state.repairs else {}
        snapshots = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
        attachments = {path.name: path.read_bytes() for path in snapshots}
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
