"""A session opened for calculations: its rig, the calibration in use, and its store of finished work.

A recording at a URL is fetched once, as a whole, and accepted by its checksum only.
"""

from __future__ import annotations

import importlib
import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from pydantic import AliasPath, BaseModel, Field, ValidationError

from brushloop.calibrate.artefact import FITS, FOLDER, POINTER, Artefact, current, load_artefact, made_by, pointed
from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded, replacing
from brushloop.calibrate.work import FOLDER as FINISHED
from brushloop.calibrate.work import Store
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.errors import in_one_line
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Stroke

Kind = Literal["press", "drag"]
EFFECTIVE = "rig.effective.json"
"""The configuration in effect: rig.toml, with the changes that the environment made."""
OTHER_KIND = {
    "press": "holds drags, which `fit` and `validate` take: this needs presses",
    "drag": "holds presses: this needs drags",
}
URL = re.compile(r"^[a-z][a-z0-9+.-]+://", re.IGNORECASE)
SCHEMES = ("file", "memory", "http", "https", "s3", "gs")
"""Others of fsspec, such as archives and repositories, fail in ways of their own and unpack without limit."""
STALL_S = 60.0
"""Longest wait for the next bytes of a web server."""
SHA256 = re.compile(r"\b[0-9a-f]{64}\b")


class Calibration(Plane, Artefact):
    """The paper plane in a session's photographs, the recording it comes from and the software. Never changed.

    Equal inputs give an equal file.
    """

    schema_version: Literal[4] = 4
    session_id: str
    source: str
    """`loopback rig` or `real capture`, as the recording says."""
    recording_sha256: str
    software: str
    board: BoardSpec
    still_sha256: str
    """sha256 of the encoded photograph of the board that this was measured on."""


@dataclass(frozen=True, slots=True)
class OpenSession:
    """A recording with what its strokes are read with."""

    recording: Recording
    sha256: str
    strokes: tuple[Stroke, ...]
    """At least one."""
    calibration: Calibration | None
    """None for an import, which has its own scale."""
    store: Store

    @property
    def header(self) -> Header:
        """Where the strokes come from."""
        return self.recording.header

    @property
    def calibration_digest(self) -> str:
        """Digest of the calibration; empty for an import."""
        return "" if self.calibration is None else self.calibration.digest

    @property
    def provenance(self) -> dict[str, Any]:
        """The fields of a `SessionFit` that say what it was fitted to, and by which software."""
        header = self.header
        origin = {"session_id": header.session_id, "source": str(header.source), "recording_sha256": self.sha256}
        return origin | {"calibration": self.calibration_digest, "software": made_by()}


def open_session(path: Path, kind: Kind | None = None) -> OpenSession:
    """Open a session by its folder or MCAP file, with the calibration in use.

    Raises `InputError`, and `CalibrationError` for a session without strokes, with some of another kind, without a
    calibration, or with that of another recording.
    """
    recording = Recording(path)
    sha256, strokes = recording.sha256, tuple(recording.stroke_records())
    if not strokes:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if kind is not None and any(stroke.kind != kind for stroke in strokes):
        raise CalibrationError(str(recording.path), OTHER_KIND[kind])
    folder, calibration = recording.path.parent, None
    if strokes[0].px_per_mm is None:
        used = current(folder)
        if used is None:
            raise CalibrationError(str(recording.path), f"is not calibrated: run `brushloop calibrate {folder}`")
        calibration = load_artefact(used, Calibration)
        if calibration.recording_sha256 != sha256:
            problem = f"belongs to another recording ({calibration.session_id}): `brushloop calibrate` makes its own"
            raise CalibrationError(str(used), problem)
    return OpenSession(recording, sha256, strokes, calibration, Store(folder / FINISHED))


class RigView(BaseModel):
    """What a session recorded of the rig."""

    board: BoardSpec
    sheet_mm: tuple[float, float] | None = Field(default=None, validation_alias=AliasPath("paper", "size_mm"))
    """Width and height of the sheet that lies on the board; None if not recorded."""
    lens: Lens | None = Field(default=None, validation_alias=AliasPath("camera", "optics"))
    """The lens that the session was collected with, if any."""


def rig_of(session: Recording | Path) -> RigView:
    """The rig of a recording, or of the folder of a session that may still be open. Raises `CalibrationError`."""
    inside = isinstance(session, Recording)
    where = f"{session.path} {EFFECTIVE}" if inside else str(session / EFFECTIVE)
    data = session.attachment(EFFECTIVE) if inside else read_bounded(session / EFFECTIVE)
    try:
        return RigView.model_validate_json(data)
    except ValidationError as error:
        raise invalid(where, error) from None


def local_path(place: str) -> Path:
    """The path, or that of a copy of the recording at a URL in this user's cache. Raises `CalibrationError`."""
    if not URL.match(place):
        return Path(place)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    address, _, fragment = place.partition("#")
    scheme = address.partition(":")[0].lower()
    if scheme not in SCHEMES or "::" in address:
        raise CalibrationError(address, f"cannot be opened, allowed: {', '.join(f'{name}://' for name in SCHEMES)}")
    try:
        return _fetched(address, scheme, fragment, cache / "brushloop" / "recordings")
    except CalibrationError:
        raise
    except ImportError as error:
        extra = "remote" if scheme.startswith("http") else scheme
        raise CalibrationError(address, f"{in_one_line(error)}: pip install 'brushloop[{extra}]'") from None
    except Exception as error:  # every backend of fsspec has errors of its own, most without a common base class
        raise CalibrationError(address, f"cannot be read: {in_one_line(error)}") from None


def _fetched(address: str, scheme: str, fragment: str, folder: Path) -> Path:
    """Copy a remote recording to `folder`, with its calibration and fit."""
    untyped: Any = importlib.import_module("fsspec")  # without type stubs
    options: dict[str, Any] = {}
    if scheme.startswith("http"):  # a server that stalls is given up, however long a whole recording takes
        aiohttp: Any = importlib.import_module("aiohttp")
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=STALL_S, sock_read=STALL_S)
        options = {"client_kwargs": {"timeout": timeout}}
    system, where = untyped.core.url_to_fs(address, **options)
    system.invalidate_cache()  # fsspec caches listings per address for the life of the process
    if not where.endswith(".mcap"):
        where = f"{where.rstrip('/')}/{PurePosixPath(where).name}.mcap"
    checksum = SHA256.search(fragment or (_read(system, f"{where}.sha256") or b"").decode("utf-8", "replace"))
    if checksum is None:
        what = "has no checksum: add #sha256=... to the URL, or put it into a file beside it, <recording>.mcap.sha256"
        raise CalibrationError(address, what)
    target = folder / checksum[0] / PurePosixPath(where).name
    if not (target.is_file() and file_sha256(target) == checksum[0]):
        target.parent.mkdir(parents=True, exist_ok=True)
        with replacing(target) as part:
            system.get_file(where, str(part))
            if (digest := file_sha256(part)) != checksum[0]:
                raise CalibrationError(address, f"has SHA-256 {digest}, {checksum[0]} was expected")
    for kind in (FOLDER, FITS):
        there, here = f"{where.rsplit('/', 1)[0]}/{kind}", target.parent / kind
        pointer = _read(system, f"{there}/{POINTER}")
        if pointer is not None and (data := _read(system, f"{there}/{pointed(pointer, POINTER)}")) is not None:
            here.mkdir(exist_ok=True)
            (here / pointed(pointer, POINTER)).write_bytes(data)
            (here / POINTER).write_bytes(pointer)
    return target


def _read(system: Any, name: str) -> bytes | None:
    """Read a small remote file; None if it does not exist, or where a bucket that may not be listed does not say so."""
    try:
        return system.cat_file(name)
    except (FileNotFoundError, PermissionError):
        return None
