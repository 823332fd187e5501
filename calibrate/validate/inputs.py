"""Sessions to validate, from local paths or URLs, and what `loop` and `write` left beside them.

A remote recording is copied once, up to a size limit, and accepted only with the expected SHA-256, which is given as
`#sha256=...` after the URL or in a file `<recording>.mcap.sha256` beside it. A loop or a written character names the
recordings it was made from. It is used only if those are the sessions being validated, or at least have the same kind
of ink; a damaged, edited or unrelated file is refused by name before hours of work begin.
"""

from __future__ import annotations

import hashlib
import importlib
import re
import struct
import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any

from brushloop.calibrate.artefact import FOLDER, MAX_POINTER_BYTES, POINTER, current, load_artefact, pointed
from brushloop.calibrate.errors import CalibrationError, one_line
from brushloop.calibrate.files import read_bounded, replacing
from brushloop.calibrate.fit.brush import FOLDER as FITS
from brushloop.calibrate.fit.brush import BrushFit
from brushloop.calibrate.loop.compare import FILE as LOOP_FILE
from brushloop.calibrate.loop.compare import LoopRecord, read_loop
from brushloop.calibrate.report import png_uri
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.session import open_session as open_recording
from brushloop.calibrate.writing.scores import FILE as WRITTEN_FILE
from brushloop.calibrate.writing.scores import PICTURE, WrittenRecord, read_written
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.records import Source

PIECE = 1024 * 1024
MAX_DOWNLOAD_BYTES = 64 * 1024**3
MAX_SUM_BYTES = 64 * 1024
MAX_ARTEFACT_BYTES = 4 * 1024 * 1024
FORBIDDEN = 403
"""HTTP status for a missing file in a bucket that may not be listed."""
URL = re.compile(r"^[a-z][a-z0-9+.-]+://", re.IGNORECASE)
EXTRAS = {"http": "remote", "https": "remote", "s3": "s3", "s3a": "s3", "gs": "gs", "gcs": "gs"}
"""URL scheme -> the extra that supports it."""
SCHEMES = ("file", "memory", *EXTRAS)
"""Others of fsspec, such as archives and repositories, fail in ways of their own and unpack without limit."""
STALL_S = 60.0
"""Longest wait for the next bytes of a web server."""
SHA256 = re.compile(r"\b[0-9a-f]{64}\b")
LOOP_FOLDER, WRITTEN_FOLDER = "loop", "written"
"""Default output folders of those commands: in the session, and next to the folder of sessions."""
MAX_PICTURE_BYTES = 16 * 1024 * 1024
MAX_SIDE_PX = 20_000
PNG_HEAD = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"


@dataclass(frozen=True, slots=True)
class FittedSession(OpenSession):
    """An open session and the brush fit that it uses."""

    fit: BrushFit | None

    @property
    def kind(self) -> str:
        """Kind of its strokes, `press` or `drag`."""
        return self.strokes[0].kind


def open_session(place: str, work: Path, calibration: Path | None, fit: Path | None) -> FittedSession:
    """Open a session by path or URL. Raises `CalibrationError`, `InputError` or `SessionDamaged`, each naming it."""
    opened = open_recording(fetched(place, work / "remote") if URL.match(place) else Path(place), calibration)
    path = opened.recording.path
    closed = replay(path.parent / JOURNAL_NAME).closed if (path.parent / JOURNAL_NAME).is_file() else None
    if closed is not None and closed.sha256 != opened.sha256:
        raise SessionDamaged(path, "is not the file that the session was closed with: its SHA-256 differs")
    if len({stroke.kind for stroke in opened.strokes}) > 1:
        raise CalibrationError(str(path), "mixes presses and drags; validate them as two sessions")
    # A fit of drags is read with the strokes that it predicts.
    used = None if opened.strokes[0].kind == "drag" else fit or current(path.parent, FITS)
    shared = {part.name: getattr(opened, part.name) for part in fields(opened)}
    return FittedSession(**shared, fit=None if used is None else load_artefact(used, BrushFit))


def one_source(sessions: Sequence[OpenSession]) -> Source:
    """Kind of ink of all recordings. Raises `CalibrationError` if they differ."""
    first = sessions[0]
    for other in sessions[1:]:
        if other.header.source != first.header.source:
            what = f"is {other.header.source}, {first.recording.path.name} is {first.header.source}"
            raise CalibrationError(str(other.recording.path), f"{what}: validate them separately")
    return first.header.source


def local_path(place: str) -> Path:
    """The path, or that of a copy of the recording at a URL in this machine's temporary folder."""
    return fetched(place, Path(tempfile.gettempdir()) / "brushloop-recordings") if URL.match(place) else Path(place)


def fetched(url: str, folder: Path) -> Path:
    """Copy a remote recording to `folder`, with its calibration and fit. Raises `CalibrationError`."""
    address, _, fragment = url.partition("#")
    scheme = address.partition(":")[0].lower()
    if scheme not in SCHEMES or "::" in address:
        raise CalibrationError(address, f"cannot be opened, allowed: {', '.join(f'{name}://' for name in SCHEMES)}")
    try:
        untyped: Any = importlib.import_module("fsspec")  # without type stubs
    except ImportError:
        raise CalibrationError(address, "a URL needs fsspec: pip install 'brushloop[remote]'") from None
    try:
        system, where = untyped.core.url_to_fs(address, **_limits(scheme))
        system.invalidate_cache()  # fsspec caches listings per address for the life of the process
    except (ImportError, ValueError) as error:
        extra = EXTRAS.get(scheme) if isinstance(error, ImportError) else None
        how = f": pip install 'brushloop[{extra}]'" if extra else ""
        raise CalibrationError(address, f"cannot be opened: {one_line(error)}{how}") from None
    try:
        if not where.endswith(".mcap"):
            where = f"{where.rstrip('/')}/{PurePosixPath(where).name}.mcap"
        expected = _expected(system, where, address, fragment)
        target = folder / expected / PurePosixPath(where).name
        if not (target.is_file() and file_sha256(target) == expected):
            _copy(system, where, target, expected, address)
        for kind in (FOLDER, FITS):
            _copy_artefact(system, f"{where.rsplit('/', 1)[0]}/{kind}", target.parent / kind)
    except CalibrationError:
        raise
    except Exception as error:  # every backend of fsspec has errors of its own, most without a common base class
        raise CalibrationError(address, f"cannot be read: {one_line(error)}") from None
    return target


def _limits(scheme: str) -> dict[str, Any]:
    """Options of fsspec: a web server that stalls is given up, however long a whole recording takes."""
    if not scheme.startswith("http"):
        return {}
    untyped: Any = importlib.import_module("aiohttp")
    return {"client_kwargs": {"timeout": untyped.ClientTimeout(total=None, sock_connect=STALL_S, sock_read=STALL_S)}}


def _expected(system: Any, where: str, address: str, fragment: str) -> str:
    text = fragment
    if not text and system.exists(f"{where}.sha256"):
        text = b"".join(_pieces(system, f"{where}.sha256", MAX_SUM_BYTES, address)).decode("utf-8", "replace")
    found = SHA256.search(text)
    if found is None:
        what = "has no checksum: add #sha256=... to the URL, or put it into a file beside it, <recording>.mcap.sha256"
        raise CalibrationError(address, what)
    return found[0]


def _copy(system: Any, where: str, target: Path, expected: str, address: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    with replacing(target) as part, part.open("wb") as out:
        for piece in _pieces(system, where, MAX_DOWNLOAD_BYTES, address):
            digest.update(piece)
            out.write(piece)
        if digest.hexdigest() != expected:
            raise CalibrationError(address, f"has SHA-256 {digest.hexdigest()}, {expected} was expected")


def _pieces(system: Any, where: str, most_bytes: int, address: str) -> Iterator[bytes]:
    """Read a remote file in pieces. Raises `CalibrationError` beyond `most_bytes`."""
    # Reading by blocks, fsspec requests ranges, which some web servers do not support.
    options = {"block_size": 0} if "http" in system.protocol else {}
    size = 0
    with system.open(where, "rb", **options) as file:
        while piece := file.read(PIECE):
            size += len(piece)
            if size > most_bytes:
                raise CalibrationError(address, f"is larger than {most_bytes} bytes")
            yield piece


def _copy_artefact(system: Any, there: str, here: Path) -> None:
    """Copy the artefact that the pointer beside a remote recording names, if there is one."""
    pointer = _read(system, f"{there}/{POINTER}", MAX_POINTER_BYTES)
    for old in (here / POINTER, *here.glob("*.json")):
        old.unlink(missing_ok=True)  # copies from an earlier run
    if pointer is None:
        return
    name = pointed(pointer, POINTER)
    here.mkdir(exist_ok=True)
    if (data := _read(system, f"{there}/{name}", MAX_ARTEFACT_BYTES)) is not None:
        (here / name).write_bytes(data)
    (here / POINTER).write_bytes(pointer)


def _read(system: Any, name: str, most_bytes: int) -> bytes | None:
    """Read a remote file; None if it does not exist. Raises `CalibrationError` beyond `most_bytes`."""
    try:
        return b"".join(_pieces(system, name, most_bytes, name))
    except (FileNotFoundError, PermissionError):
        return None
    except Exception as error:
        if getattr(error, "status", None) == FORBIDDEN:
            return None
        raise


@dataclass(frozen=True, slots=True)
class Extras:
    """The loops and characters that go into a report."""

    loops: tuple[LoopRecord, ...] = ()
    written: tuple[WrittenRecord, ...] = ()
    figures: tuple[str, ...] = ()
    """Figure 13 of each of `written` as a data URI; empty if the picture is missing."""
    notes: tuple[str, ...] = ()
    """What was found and left out, or is missing, and why."""


def find_extras(
    sessions: Sequence[OpenSession], loops: Sequence[Path], written: Sequence[Path], *, beside: bool
) -> Extras:
    """Read the loops and characters named; of a kind without any, those beside the sessions if `beside` is true.

    Raises `CalibrationError` that names an unusable file.
    """
    notes: list[str] = []
    repeated: dict[str, LoopRecord] = {}
    folders = [session.recording.path.resolve().parent for session in sessions]
    places = [session.recording.path.parent / LOOP_FOLDER for session in sessions] if beside else []
    for path in _files(loops, LOOP_FILE) or _present(places, LOOP_FILE):
        with _naming_no_beside(requested=bool(loops)):
            record = read_loop(path)
            _check_loop(path, record, sessions)
        repeated[record.digest] = record
    characters: dict[str, tuple[WrittenRecord, str]] = {}
    near = [place / WRITTEN_FOLDER for folder in folders for place in (folder, folder.parent.parent) if beside]
    for path in _files(written, WRITTEN_FILE) or _present(near, WRITTEN_FILE):
        with _naming_no_beside(requested=bool(written)):
            record = read_written(path)
            if not written and path.parent.parent not in folders and (why := _foreign(record, sessions, folders)):
                notes.append(f"{path} is left out: {why}; --written uses it")
                continue
            _check_source(path, record.source, sessions)
            picture = path.parent / PICTURE
            characters[record.digest] = record, figure_13(picture, record) if picture.exists() else ""
        if not picture.exists():
            notes.append(f"{picture} does not exist: the report has no Figure 13 of {record.session}")
    records, figures = (tuple(part) for part in zip(*characters.values(), strict=True)) if characters else ((), ())
    return Extras(tuple(repeated.values()), records, figures, tuple(notes))


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


def _present(folders: Sequence[Path], name: str) -> list[Path]:
    """The files of that name in these folders, each once."""
    return [path for path in dict.fromkeys(folder / name for folder in folders) if path.is_file()]


def _foreign(record: WrittenRecord, sessions: Sequence[OpenSession], folders: Sequence[Path]) -> str:
    """Explain why characters found near the sessions do not belong to them; empty if they do."""
    source = one_source(sessions)
    if record.source != source:
        return f"it is of {record.source}, not {source}"
    named = record.session not in ("", ".", "..") and Path(record.session).name == record.session
    if not named or not any((folder.parent / record.session).is_dir() for folder in folders):
        return f"its session {record.session} is not beside it"
    brushes = {session.header.brush for session in sessions}
    return "" if brushes == {record.brush} else f"it was written with another brush, {record.brush or 'not named'}"


def _check_loop(path: Path, record: LoopRecord, sessions: Sequence[OpenSession]) -> None:
    _check_source(path, record.source, sessions)
    if record.original_sha256 in {session.sha256 for session in sessions}:
        return
    names = [session.header.session_id for session in sessions]
    if record.original in names:
        why = f"is of another recording of {record.original}: its SHA-256 differs; `{record.MADE_BY}` compares again"
        raise CalibrationError(str(path), why)
    raise CalibrationError(str(path), f"repeats {record.original}, not {', '.join(names)}")


def _check_source(path: Path, source: Source, sessions: Sequence[OpenSession]) -> None:
    here, recording = one_source(sessions), sessions[0].recording.path.name
    if source != here:
        raise CalibrationError(str(path), f"is of {source}, {recording} of {here}: one report cannot hold both")


@contextmanager
def _naming_no_beside(*, requested: bool) -> Generator[None]:
    """Add a hint at --no-beside to an error about a file that was found, not requested."""
    try:
        yield
    except CalibrationError as error:
        if not requested:
            error.add_note("(found beside the session; --no-beside ignores it)")
        raise
