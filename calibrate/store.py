"""Finished work of a session, kept in its folder so that no command does it again: arrays by key.

A key names everything that the arrays depend on, so an entry never has to be changed. Each entry is a file of its own,
an `.npz` archive without pickles in gzip, whose checksum tells damage: work that is damaged, too large or missing is
done again. The folder may be deleted at any time.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.files import replacing

VERSION = "6"
"""Part of every key. Increase it when the result of some work for the same input changes."""
FOLDER = "work"
"""Folder of a session that holds its finished work."""
MAX_ENTRY_BYTES = 16 * 1024**2
"""Largest entry once it is unpacked."""
MAX_BYTES = 4 * 1024**3
"""Largest sum of all entries on disk; the oldest are removed first."""
UNREADABLE = (OSError, EOFError, ValueError, zlib.error, zipfile.BadZipFile)
Arrays = Mapping[str, NDArray[Any]]


def key_of(*parts: object) -> str:
    """A key for everything that determines some work; arrays count with shape, type and values."""
    digest = hashlib.sha256(VERSION.encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            array = cast("NDArray[Any]", part)
            digest.update(f"\0{array.dtype} {array.shape} ".encode() + array.tobytes())
        else:
            digest.update(f"\0{part}".encode())
    return digest.hexdigest()


class Store:
    """The entries of one folder by key. What cannot be written stays in memory, so that read-only sessions work too."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._unwritten: dict[str, Arrays] = {}
        self._trim()

    def __contains__(self, key: str) -> bool:
        return key in self._unwritten or self._path(key).is_file()

    def get(self, key: str) -> Arrays | None:
        """The arrays of an entry; None where there is none, or it is damaged: it is then put again."""
        if key in self._unwritten:
            return self._unwritten[key]
        try:
            with gzip.open(self._path(key)) as file:
                data = file.read(MAX_ENTRY_BYTES)  # a larger entry is cut off, and so damaged
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                return dict(arrays)
        except UNREADABLE:
            return None

    def put(self, key: str, arrays: Arrays) -> None:
        """Add an entry; once this returns, killing the process does not lose it."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **dict(arrays))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with replacing(self._path(key)) as part:
                part.write_bytes(gzip.compress(buffer.getvalue(), compresslevel=1, mtime=0))
        except OSError:
            self._unwritten[key] = arrays

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.npz.gz"

    def _trim(self) -> None:
        """Remove the oldest entries beyond `MAX_BYTES`."""
        entries = [(path, path.stat()) for path in self._folder.glob("*.npz.gz")]
        left = sum(stat.st_size for _, stat in entries) - MAX_BYTES
        for path, stat in sorted(entries, key=lambda entry: entry[1].st_mtime_ns):
            if left <= 0:
                break
            path.unlink(missing_ok=True)
            left -= stat.st_size
