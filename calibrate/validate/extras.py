"""Reports of `brushloop loop` and `brushloop write` that go into the tables: strokes pressed again, characters written.

Each file names the recordings it was made from. It is used only if those are the sessions being validated, or at least
have the same kind of ink; a damaged, edited or unrelated file is refused by name before hours of work begin.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded
from brushloop.calibrate.loop.scores import FILE as LOOP_FILE
from brushloop.calibrate.loop.scores import LoopRecord, read_loop
from brushloop.calibrate.report import png_uri
from brushloop.calibrate.validate.sources import LoadedSession, one_source
from brushloop.calibrate.writing.scores import FILE as WRITTEN_FILE
from brushloop.calibrate.writing.scores import PICTURE, WrittenRecord, read_written

LOOP_FOLDER, WRITTEN_FOLDER = "loop", "written"
"""Default output folders of those commands: in the session, and next to the folder of sessions."""
MAX_PICTURE_BYTES = 16 * 1024 * 1024
MAX_SIDE_PX = 20_000
PNG_HEAD = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"


@dataclass(frozen=True, slots=True)
class ExtrasRequest:
    """Files or folders to use; if none are named and `look` is true, those found with the sessions."""

    loops: tuple[Path, ...] = ()
    written: tuple[Path, ...] = ()
    look: bool = True


@dataclass(frozen=True, slots=True)
class Extras:
    """The loops and characters that go into a report."""

    loops: tuple[LoopRecord, ...] = ()
    written: tuple[WrittenRecord, ...] = ()
    figures: tuple[str, ...] = ()
    """Figure 13 of each of `written` as a data URI; empty if the picture is missing."""
    notes: tuple[str, ...] = ()
    """What was found and left out, or is missing, and why."""


def find_extras(sessions: Sequence[LoadedSession], request: ExtrasRequest) -> Extras:
    """Read and check all extras. Raises `CalibrationError` that names an unusable file."""
    notes: list[str] = []
    loops: dict[str, LoopRecord] = {}
    for path in _files(request.loops, LOOP_FILE) or (_loops_beside(sessions) if request.look else ()):
        with _naming_no_beside(requested=bool(request.loops)):
            record = read_loop(path)
            _check_loop(path, record, sessions)
        loops[record.digest] = record
    written: dict[str, tuple[WrittenRecord, str]] = {}
    for path in _files(request.written, WRITTEN_FILE) or (_written_beside(sessions) if request.look else ()):
        with _naming_no_beside(requested=bool(request.written)):
            found = read_written(path)
            if not request.written and (why := _foreign(path, found, sessions)):
                notes.append(f"{path} is left out: {why}; --written uses it")
                continue
            _check_written(path, found, sessions)
            picture = path.parent / PICTURE
            written[found.digest] = found, figure_13(picture, found) if picture.exists() else ""
        if not written[found.digest][1]:
            notes.append(f"{picture} does not exist: the report has no Figure 13 of {found.session}")
    records, figures = tuple(one for one, _ in written.values()), tuple(uri for _, uri in written.values())
    return Extras(tuple(loops.values()), records, figures, tuple(notes))


def figure_13(path: Path, record: WrittenRecord) -> str:
    """Figure 13 as a data URI. Raises `CalibrationError` unless it is the PNG written with the record."""
    data = read_bounded(path, MAX_PICTURE_BYTES)
    if not data.startswith(PNG_HEAD) or len(data) < len(PNG_HEAD) + 8:
        raise CalibrationError(str(path), "is not a PNG")
    sides: tuple[int, int] = struct.unpack_from(">II", data, len(PNG_HEAD))
    if not all(1 <= side <= MAX_SIDE_PX for side in sides):
        raise CalibrationError(str(path), f"has {sides[0]} x {sides[1]} px, at most {MAX_SIDE_PX} a side are shown")
    if hashlib.sha256(data).hexdigest() != record.figure_13_sha256:
        raise CalibrationError(str(path), f"is not the picture of {WRITTEN_FILE} beside it: its SHA-256 differs")
    return png_uri(data)


def _files(paths: Sequence[Path], name: str) -> list[Path]:
    return [path / name if path.is_dir() else path for path in paths]


def _loops_beside(sessions: Sequence[LoadedSession]) -> Iterator[Path]:
    for one in sessions:
        path = one.recording.path.parent / LOOP_FOLDER / LOOP_FILE
        if path.is_file():
            yield path


def _written_beside(sessions: Sequence[LoadedSession]) -> Iterator[Path]:
    """Yield reports of characters in a session or next to the folder of sessions, each once."""
    seen: set[Path] = set()
    for one in sessions:
        folder = one.recording.path.resolve().parent
        for place in (folder, folder.parent.parent):
            path = place / WRITTEN_FOLDER / WRITTEN_FILE
            if path.is_file() and path not in seen:
                seen.add(path)
                yield path


def _foreign(path: Path, record: WrittenRecord, sessions: Sequence[LoadedSession]) -> str:
    """Explain why characters found near the sessions do not belong to them; empty if they do."""
    folders = [one.recording.path.resolve().parent for one in sessions]
    if path.parent.parent in folders:
        return ""
    source = one_source(list(sessions))
    if record.source != source:
        return f"it is of {record.source}, not {source}"
    named = record.session not in ("", ".", "..") and Path(record.session).name == record.session
    if not named or not any((folder.parent / record.session).is_dir() for folder in folders):
        return f"its session {record.session} is not beside it"
    brushes = {one.header.brush for one in sessions}
    return "" if brushes == {record.brush} else f"it was written with another brush, {record.brush or 'not named'}"


def _check_loop(path: Path, record: LoopRecord, sessions: Sequence[LoadedSession]) -> None:
    _check_source(path, record.source, [row.source for row in record.table_1], sessions)
    if any((row.original, row.again) != (record.original, record.again) for row in record.table_1):
        raise CalibrationError(str(path), "table_1: has rows of other sessions than its own")
    if record.original_sha256 in {one.sha256 for one in sessions}:
        return
    names = ", ".join(one.header.session_id for one in sessions)
    if any(one.header.session_id == record.original for one in sessions):
        why = f"is of another recording of {record.original}: its SHA-256 differs; `{record.MADE_BY}` compares again"
        raise CalibrationError(str(path), why)
    raise CalibrationError(str(path), f"repeats {record.original}, not {names}")


def _check_written(path: Path, record: WrittenRecord, sessions: Sequence[LoadedSession]) -> None:
    _check_source(path, record.source, [row.source for row in record.table_3], sessions)
    if any(row.session_id != record.session for row in record.table_3):
        raise CalibrationError(str(path), "table_3: has rows of another session than its own")


def _check_source(path: Path, named: str, rows: Sequence[str], sessions: Sequence[LoadedSession]) -> None:
    source = one_source(list(sessions))
    for one in (named, *rows):
        if one != source:
            recording = sessions[0].recording.path.name
            raise CalibrationError(str(path), f"is of {one}, {recording} of {source}: one report cannot hold both")


@contextmanager
def _naming_no_beside(*, requested: bool) -> Generator[None]:
    """Add a hint at --no-beside to an error about a file that was found, not requested."""
    try:
        yield
    except CalibrationError as error:
        if not requested:
            error.add_note("(found beside the session; --no-beside ignores it)")
        raise
