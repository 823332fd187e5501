"""Repair a session: give back every intact finished stroke, mark the rest as lost, say what was done.

Nothing recorded is overwritten or deleted: a damaged original is kept as `<name>.damaged-1`. Cut short anywhere and
started again, a repair comes to the same end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from sessions.errors import InputError, SessionDamaged, disk_error
from sessions.journal.journal import JOURNAL_NAME
from sessions.reader import parse_header
from sessions.recording.salvage import scan
from sessions.recording.schemas import Topic
from sessions.recording.writer import HEADER_METADATA, header_crc
from sessions.renamed import check_name, not_a_session
from sessions.repair.folder import FolderRepair
from sessions.repair.journal import Report, kept_words
from sessions.repair.rewrite import lost_words, replace_damaged, with_their_stills
from sessions.store import SEGMENT_NAME, lock
from sessions.verify import verify_session


def repair_session(path: Path, now_ns: Callable[[], int]) -> Report:
    """Repair a session's folder, or one MCAP file. Raises `SessionDamaged` where nothing can be rebuilt.

    `InputError` for what is no session, and for a folder that was renamed: there is nothing to repair about that.
    `SessionLocked` while another process has the session, `DiskFull` and `SessionError` where the disk fails.
    """
    target = path.resolve()
    if not target.exists():
        raise InputError(path, "no such session: give a session's folder or its .mcap file")
    try:
        check_name(path)
        if target.is_file():
            return _repair_file(target)
        files = [file.name for file in target.glob("*.mcap*")]
        if not (target / JOURNAL_NAME).exists() and not any(map(SEGMENT_NAME.fullmatch, files)):
            final = target / f"{target.name}.mcap"
            if not final.is_file():
                raise not_a_session(path)
            return _repair_file(final)
        held = lock(target)
        try:
            return FolderRepair(target, now_ns).run()
        finally:
            held.release()
    except OSError as error:
        raise disk_error(target, "cannot be repaired", error) from error


def _repair_file(path: Path) -> Report:
    """A recording that stands alone: an import, or a merged file without its session."""
    report = Report(path.name)
    verdict = verify_session(path)
    report.strokes = verdict.strokes
    if verdict.sound:
        return report
    found = scan(path)
    metadata = found.metadata.get(HEADER_METADATA)
    if metadata is None:
        raise SessionDamaged(path, "nothing is left that tells its header; it cannot be repaired")
    header = parse_header(path, metadata)
    if metadata.get("crc", "") not in ("", header_crc(metadata)):
        report.lost.append("the certainty of its header: it does not match its CRC, and is kept as it reads")
    strokes = with_their_stills(found)
    notes = {name: values for name, values in found.notes.items() if name != HEADER_METADATA}
    files = {attachment.name: attachment.data for attachment in found.attachments}
    kept, counts = replace_damaged(path, header, notes, files, strokes.messages())
    why = "; ".join(finding.what for finding in verdict.findings)
    report.did.append(f"wrote {path.name} again from what can be read of it: {why}{kept_words(kept)}")
    report.strokes = counts.get(Topic.STROKE, 0)
    report.lost += lost_words(strokes, Counter(found.stated or {}), counts)
    if found.stated is None and (not found.complete or any(part.counts is None for part in found.parts)):
        report.lost.append("whatever else lay behind the damage: without its index nobody knows how much that was")
    if found.stated is None:
        return report
    if len(files) < found.stated_attachments or len(found.notes) < found.stated_notes:
        report.lost.append("an attached file, or a note of what was done to the recording")
    return report
