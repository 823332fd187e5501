"""Remarks added to captures afterwards (bad, good again, a note), kept beside the recording and never inside it.

`remarks.jsonl` holds one line per remark, with a CRC as in the journal; the latest remark on a still counts. The
recording itself is never changed, so that a closed session stays byte for byte as recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.journal import Journal, read_lines

REMARKS_NAME = "remarks.jsonl"


@dataclass(frozen=True, slots=True)
class Remark:
    """Remark on one capture."""

    still: int
    """`sequence` of the capture's still, unique in the session."""
    stroke_id: str
    bad: bool = False
    note: str = ""
    t_ns: int = 0
    """Time of the remark by the host's clock."""


def add_remark(folder: Path, remark: Remark) -> None:
    """Append a remark and wait until it is on disk. Raises `SessionError` where that fails."""
    journal = Journal(folder / REMARKS_NAME, remark.t_ns)
    try:
        line = {"event": "remark", "still": remark.still, "stroke_id": remark.stroke_id}
        journal.append(remark.t_ns, {**line, "bad": remark.bad, "note": remark.note})
    finally:
        journal.close()


def mark_bad_or_good(folder: Path, still: int, stroke_id: str, t_ns: int) -> bool:
    """Switch a capture between bad and good, keep its note, and return whether it is bad now. Raises `SessionError`."""
    known = remarks_of(folder).get(still, Remark(still, stroke_id))
    add_remark(folder, Remark(still, stroke_id, not known.bad, known.note, t_ns))
    return not known.bad


def remarks_of(folder: Path) -> dict[int, Remark]:
    """Latest remark for each still; empty where there is none. Raises `SessionDamaged`."""
    path = folder / REMARKS_NAME
    found: dict[int, Remark] = {}
    for line in read_lines(path) if path.is_file() else ():
        if line["event"] != "remark":
            continue
        try:
            still, t_ns = int(line["still"]), int(line["t_ns"])
            found[still] = Remark(still, str(line["stroke_id"]), bool(line["bad"]), str(line["note"]), t_ns)
        except (KeyError, TypeError, ValueError) as error:
            raise SessionDamaged(path, f"a remark has a missing or wrong field: {error}") from None
    return found
