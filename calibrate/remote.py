"""Recordings at URLs: each is fetched once, as a whole, and accepted by its checksum only."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from brushloop.calibrate.artefact import FOLDER, POINTER, pointed
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import replacing
from brushloop.calibrate.fit.fit import FOLDER as FITS
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.errors import in_one_line

URL = re.compile(r"^[a-z][a-z0-9+.-]+://", re.IGNORECASE)
SCHEMES = ("file", "memory", "http", "https", "s3", "gs")
"""Others of fsspec, such as archives and repositories, fail in ways of their own and unpack without limit."""
STALL_S = 60.0
"""Longest wait for the next bytes of a web server."""
SHA256 = re.compile(r"\b[0-9a-f]{64}\b")


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
