"""What people say of captures afterwards: bad, good after all, a note. Appended beside the recording, never into it.

`remarks.jsonl` holds one line a remark, with a CRC like the journal's; a later remark on the same still holds. The
recording itself is never changed, so a closed session stays byte for byte what was recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sessions.errors import SessionDamaged
from sessions.journal.journal import Journal, read_lines

REMARKS_NAME = "remarks.jsonl"


@dataclass(frozen=True, slots=True)
class Remark:
    """What holds of one capture."""

    still: int
    """`sequence` of the capture's still, unique in the session."""
    stroke_id: str
    bad: bool = False
    note: str = ""
    t_ns: int = 0
    """When it was said, by the host's clock."""


def add_remark(folder: Path, remark: Remark) -> None:
    """Append a remark and wait until it is on disk. Raises `SessionError` where that fails."""
    journal = Journal(folder / REMARKS_NAME, remark.t_ns)
    try:
        line = {"event": "remark", "still": remark.still, "stroke_id": remark.stroke_id}
        journal.append(remark.t_ns, {**line, "bad": remark.bad, "note": remark.note})
    finally:
        journal.close()


def mark_bad_or_good(folder: Path, still: int, stroke_id: str, t_ns: int) -> bool:
    """Say the other of bad and good about a capture, its note kept; True for bad now. Raises `SessionError`."""
    known = remarks_of(folder).get(still, Remark(still, stroke_id))
    add_remark(folder, Remark(still, stroke_id, not known.bad, known.note, t_ns))
    return not known.bad


def remarks_of(folder: Path) -> dict[int, Remark]:
    """The latest remark by still; empty where nobody said anything. Raises `SessionDamaged`."""
    path = folder / REMARKS_NAME
    found: dict[int, Remark] = {}
    for line in read_lines(path) if path.is_file() else ():
        if line["event"] != "remark":
            continue
        try:
            still, t_ns = int(line["still"]), int(line["t_ns"])
            found[still] = Remark(still, str(line["stroke_id"]), bool(line["bad"]), str(line["note"]), t_ns)
        except (KeyError, TypeError, ValueError) as error:
            raise SessionDamaged(path, f"a remark lacks or spoils {error}") from None
    return found
