"""Finished work on disk, so that a killed run can resume: one SQLite file of records by key.

A key is a hash of everything that determines its record; the body is CBOR with a CRC-32. A record is written completely
or not at all; one that does not match its CRC is dropped and computed again.
"""

from __future__ import annotations

import errno
import sqlite3
import zlib
from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import cbor2

from brushloop.calibrate.store import VERSION as VERSION

TABLE = "CREATE TABLE IF NOT EXISTS work (number INTEGER PRIMARY KEY, key TEXT UNIQUE, crc INTEGER, body BLOB)"
DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
Body = dict[str, Any]


class Store(AbstractContextManager["Store"]):
    """The records of one file by key; they stay on disk. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._as_os_error():
            try:
                self._database = self._opened()
            except sqlite3.DatabaseError as error:
                if error.sqlite_errorcode & 0xFF not in DAMAGED:
                    raise
                path.unlink()  # lost work is simply repeated
                path.with_name(path.name + "-journal").unlink(missing_ok=True)
                self._database = self._opened()

    def __contains__(self, key: str) -> bool:
        return self._database.execute("SELECT 1 FROM work WHERE key = ?", (key,)).fetchone() is not None

    def __len__(self) -> int:
        return self._database.execute("SELECT count(*) FROM work").fetchone()[0]

    def keys(self) -> list[str]:
        """Keys of all records, in the order in which they were finished."""
        return [key for (key,) in self._database.execute("SELECT key FROM work ORDER BY number")]

    def put(self, key: str, body: Body) -> None:
        """Add a record; once this returns, killing the process does not lose it."""
        packed = cbor2.dumps(body)
        with self._as_os_error(), self._database:
            row = (key, _crc(key, packed), packed)
            self._database.execute("INSERT OR REPLACE INTO work (key, crc, body) VALUES (?, ?, ?)", row)

    def get(self, key: str) -> Body:
        """The body of a record. Raises KeyError if there is none."""
        found = self._database.execute("SELECT body FROM work WHERE key = ?", (key,)).fetchone()
        if found is None:
            raise KeyError(key)
        return cbor2.loads(found[0])

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _opened(self) -> sqlite3.Connection:
        """Open the database and delete the records that do not match their CRC."""
        database = sqlite3.connect(self._path)
        try:
            # Not waiting for the disk loses nothing if the process is killed; work lost in a power cut is repeated.
            database.execute("PRAGMA synchronous = OFF")
            database.execute("PRAGMA journal_mode = TRUNCATE")
            database.execute(TABLE)
            rows = database.execute("SELECT number, key, crc, body FROM work")
            bad = [(number,) for number, key, crc, body in rows if _crc(key, body) != crc]
            with database:
                database.executemany("DELETE FROM work WHERE number = ?", bad)
        except BaseException:
            database.close()
            raise
        return database

    @contextmanager
    def _as_os_error(self) -> Generator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise OSError(errno.EIO, str(error), str(self._path)) from error


def _crc(key: object, body: object) -> int | None:
    """CRC of a record; None for values of other types, which occur only in a damaged file."""
    return zlib.crc32(key.encode() + body) if isinstance(key, str) and isinstance(body, bytes) else None
