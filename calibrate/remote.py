"""Recordings at URLs: each is fetched once, as a whole, and accepted by its checksum only."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from brushloop.calibrate.artefact import FOLDER, POINTER, pointed
from brushloop.calibrate.errors import CalibrationError, one_line
from brushloop.calibrate.files import replacing
from brushloop.calibrate.fit.brush import FOLDER as FITS
from brushloop.sessions.disk import file_sha256

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


def local_path(place: str) -> Path:
    """The path, or that of a copy of the recording at a URL in this user's cache. Raises `CalibrationError`."""
    if not URL.match(place):
        return Path(place)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return fetched(place, cache / "brushloop" / "recordings")


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
    """The checksum in the URL, or in the file beside the recording."""
    text = fragment or (_read(system, f"{where}.sha256") or b"").decode("utf-8", "replace")
    checksum = SHA256.search(text)
    if checksum is None:
        what = "has no checksum: add #sha256=... to the URL, or put it into a file beside it, <recording>.mcap.sha256"
        raise CalibrationError(address, what)
    return checksum[0]


def _copy(system: Any, where: str, target: Path, expected: str, address: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as part:
        system.get_file(where, str(part))
        digest = file_sha256(part)
        if digest != expected:
            raise CalibrationError(address, f"has SHA-256 {digest}, {expected} was expected")


def _copy_artefact(system: Any, there: str, here: Path) -> None:
    """Copy the artefact that the pointer beside a remote recording names, if there is one."""
    pointer = _read(system, f"{there}/{POINTER}")
    for old in (here / POINTER, *here.glob("*.json")):
        old.unlink(missing_ok=True)  # copies from an earlier run
    if pointer is None:
        return
    name = pointed(pointer, POINTER)
    here.mkdir(exist_ok=True)
    if (data := _read(system, f"{there}/{name}")) is not None:
        (here / name).write_bytes(data)
    (here / POINTER).write_bytes(pointer)


def _read(system: Any, name: str) -> bytes | None:
    """Read a small remote file; None if it does not exist."""
    try:
        return system.cat_file(name)
    except (FileNotFoundError, PermissionError):
        return None
    except Exception as error:
        if getattr(error, "status", None) == FORBIDDEN:
            return None
        raise
