"""Open sessions from local folders and files, or from a URL of one of `SCHEMES`.

A remote recording is copied once, up to a size limit, and accepted only with the expected SHA-256, which is given as
`#sha256=...` after the URL or in a file `<recording>.mcap.sha256` beside it.
"""

from __future__ import annotations

import hashlib
import importlib
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from brushloop.calibrate.artefact import FOLDER, MAX_POINTER_BYTES, POINTER, current, load_artefact, pointed
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError, one_line
from brushloop.calibrate.files import replacing
from brushloop.calibrate.fit.artefact import FOLDER as FITS
from brushloop.calibrate.fit.artefact import BrushFit
from brushloop.calibrate.session import calibration_of
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Source, Stroke

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
BACKEND_ERRORS = (
    ("aiohttp", "ClientError"),
    ("botocore.exceptions", "BotoCoreError"),
    ("botocore.exceptions", "ClientError"),
    ("gcsfs.retry", "HttpError"),
    ("google.auth.exceptions", "GoogleAuthError"),
)
"""Module and class: none is an OSError, and none is imported unless a URL of its scheme is given."""
SHA256 = re.compile(r"\b[0-9a-f]{64}\b")


@dataclass(frozen=True, slots=True)
class LoadedSession:
    """A session that was checked, with its calibration and fit."""

    recording: Recording
    sha256: str
    calibration: Calibration | None
    fit: BrushFit | None
    kinds: frozenset[str]
    count: int
    reached_mm: dict[str, float | None]
    """Depth that the arm reached, by name of stroke; None where the recording does not say it."""

    @property
    def header(self) -> Header:
        """The header of the recording."""
        return self.recording.header


def open_session(place: str, work: Path, calibration: Path | None, fit: Path | None) -> LoadedSession:
    """Open a session by path or URL. Raises `CalibrationError`, `InputError` or `SessionDamaged`, each naming it."""
    path = fetched(place, work / "remote") if URL.match(place) else Path(place)
    recording = Recording(path)
    digest = recording.sha256
    _check_journal(recording, digest)
    first: Stroke | None = None
    kinds, count = frozenset[str](), 0
    reached_mm: dict[str, float | None] = {}
    for stroke in recording.stroke_records():
        first = first or stroke
        kinds |= {stroke.kind}
        reached_mm[stroke.stroke_id] = stroke.reached_mm
        count += 1
    if first is None:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if len(kinds) > 1:
        raise CalibrationError(str(recording.path), "mixes presses and drags; validate them as two sessions")
    # A fit of drags is read with the strokes that it predicts.
    found = None if "drag" in kinds else fit or current(recording.path.parent, FITS)
    return LoadedSession(
        recording,
        digest,
        calibration_of(recording, first, digest, calibration),
        load_artefact(found, BrushFit) if found is not None else None,
        kinds,
        count,
        reached_mm,
    )


def one_source(sessions: list[LoadedSession]) -> Source:
    """Kind of ink of all recordings. Raises `CalibrationError` if they differ."""
    first = sessions[0]
    for other in sessions[1:]:
        if other.header.source != first.header.source:
            what = f"is {other.header.source}, {first.recording.path.name} is {first.header.source}"
            raise CalibrationError(str(other.recording.path), f"{what}: validate them separately")
    return first.header.source


def _check_journal(recording: Recording, digest: str) -> None:
    """Check that the file is the one with which the journal was closed; imports and exports have no journal."""
    journal = recording.path.parent / JOURNAL_NAME
    if not journal.is_file():
        return
    closed = replay(journal).closed
    if closed is not None and closed.sha256 != digest:
        raise SessionDamaged(recording.path, "is not the file that the session was closed with: its SHA-256 differs")


def fetched(url: str, folder: Path) -> Path:
    """Copy a remote recording to `folder`, with its calibration and fit. Raises `CalibrationError`."""
    address, _, fragment = url.partition("#")
    scheme = address.partition(":")[0].lower()
    if scheme not in SCHEMES or "::" in address:
        raise CalibrationError(address, f"cannot be opened, allowed: {', '.join(f'{one}://' for one in SCHEMES)}")
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
    except (OSError, ValueError, NotImplementedError, *_backend_errors()) as error:
        raise CalibrationError(address, f"cannot be read: {one_line(error)}") from None
    return target


def _limits(scheme: str) -> dict[str, Any]:
    """Options of fsspec: a web server that stalls is given up, however long a whole recording takes."""
    if not scheme.startswith("http"):
        return {}
    untyped: Any = importlib.import_module("aiohttp")
    return {"client_kwargs": {"timeout": untyped.ClientTimeout(total=None, sock_connect=STALL_S, sock_read=STALL_S)}}


def local_path(place: str) -> Path:
    """The path, or that of a copy of the recording at a URL in this machine's temporary folder."""
    return fetched(place, Path(tempfile.gettempdir()) / "brushloop-recordings") if URL.match(place) else Path(place)


def _backend_errors() -> tuple[type[Exception], ...]:
    """Error classes, raised without credentials, of the packages that fsspec loaded for this URL."""
    loaded = [(sys.modules[module], name) for module, name in BACKEND_ERRORS if module in sys.modules]
    return tuple(getattr(module, name) for module, name in loaded if hasattr(module, name))


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
    except _backend_errors() as error:
        if getattr(error, "status", None) == FORBIDDEN:
            return None
        raise
