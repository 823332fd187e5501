"""Repair a journal: rewrite it from its trusted lines and those found in the files, or only add lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from brushloop.sessions.disk import fsync_folder, set_aside, sync
from brushloop.sessions.journal.codec import encode_line, without_time
from brushloop.sessions.journal.journal import JOURNAL_NAME, Journal, next_chain
from brushloop.sessions.repair.evidence import Evidence
from brushloop.sessions.show import step_words


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


def repaired_journal(evidence: Evidence, session: str, now_ns: Callable[[], int], report: Report) -> Journal:
    """Repair the session's journal and open it for further lines. Raises `SessionError`."""
    if not evidence.intact:
        _rewrite(evidence, session, now_ns, report)
    journal = Journal(evidence.folder / JOURNAL_NAME, now_ns(), session)
    try:
        _add_lines(journal, evidence, now_ns, report)
    except BaseException:
        journal.close()
        raise
    return journal


def write_anew(path: Path, data: bytes) -> str:
    """Replace a file; return the name under which the old one is kept, or an empty string. Raises `OSError`."""
    kept = set_aside(path, "damaged").name if path.exists() else ""
    fresh = path.with_name(path.name + ".repair")
    with fresh.open("wb") as file:
        file.write(data)
        sync(file)
    fresh.replace(path)
    fsync_folder(path.parent)
    return kept


def _rewrite(evidence: Evidence, session: str, now_ns: Callable[[], int], report: Report) -> None:
    path = evidence.folder / JOURNAL_NAME
    data = b""
    for line in evidence.all_lines:
        data += encode_line(int(line.get("t_ns", 0)), without_time(line), next_chain(data, session))
    aside = f"{path.name}.damaged" if path.exists() else ""
    words = {"event": "journal", "aside": aside, "rebuilt": len(evidence.rebuilt), "lost": evidence.lost}
    data += encode_line(now_ns(), words, next_chain(data, session))
    kept = write_anew(path, data)
    report.did.append(
        f"wrote {JOURNAL_NAME} again: {len(evidence.lines)} lines as they were, {len(evidence.rebuilt)} rebuilt "
        f"from the files{kept_words(kept)}"
    )
    report.did += [f"  {JOURNAL_NAME}: {fault}" for fault in evidence.faults]
    if evidence.lost:
        lines = "1 line" if evidence.lost == 1 else f"{evidence.lost} lines"
        report.lost.append(f"{lines} of {JOURNAL_NAME} that no file holds")


def _add_lines(journal: Journal, evidence: Evidence, now_ns: Callable[[], int], report: Report) -> None:
    if evidence.intact:
        for line in evidence.rebuilt:
            journal.append(int(line["t_ns"]), without_time(line))
            what = step_words(line) if line["event"] != "closed" else "the session"
            shown = str(line.get("file", "the header"))
            report.did.append(f"journalled {line['event']!r} of {what}, which {shown} shows")
    sheet = evidence.state.sheet
    if evidence.doubtful and sheet not in evidence.state.doubtful_sheets:
        for name in evidence.doubtful:
            journal.append(now_ns(), {"event": "doubt", "file": name, "sheet": sheet})
            report.lost.append(
                f"which patch {name} pressed: nothing more is pressed on sheet {sheet + 1}; "
                f"go on with a fresh one, --sheet {sheet + 2}"
            )


def kept_words(name: str) -> str:
    """Say where the damaged file is kept."""
    return f"; the damaged file is kept as {name}" if name else ""
