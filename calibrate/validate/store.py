"""Finished work on disk: an append-only file of records, so that a killed run goes on where it was.

Each record is a length and a CRC, a key (a hash of everything that the record follows from) and a CBOR body. What a
crash cut off, or what does not match its CRC, is dropped and done again.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import cbor2

MAGIC = b"brushloop-work-1\n"
FRAME = struct.Struct("<IIH")
"""Bytes of key and body, their CRC-32, bytes of the key."""
MAX_RECORD_BYTES = 64 * 1024 * 1024
Body = dict[str, Any]


class Store:
    """The records of one file by key; only where they lie is held in memory. Raises OSError."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: BinaryIO = path.open("r+b" if path.exists() else "w+b")
        self._where: dict[str, tuple[int, int]] = {}
        self._end = self._scan()
        self._file.truncate(self._end)

    def __contains__(self, key: str) -> bool:
        return key in self._where

    def __len__(self) -> int:
        return len(self._where)

    def keys(self) -> list[str]:
        """Of every record, in the order in which they were finished."""
        return list(self._where)

    def put(self, key: str, body: Body) -> None:
        """Append a record; after this returns a kill of the process does not lose it."""
        name, packed = key.encode(), cbor2.dumps(body)
        payload = name + packed
        self._file.seek(self._end)
        self._file.write(FRAME.pack(len(payload), zlib.crc32(payload), len(name)) + payload)
        self._file.flush()
        self._where[key] = (self._end + FRAME.size + len(name), len(packed))
        self._end += FRAME.size + len(payload)

    def get(self, key: str) -> Body:
        """The body of a record. Raises KeyError where there is none."""
        at, size = self._where[key]
        self._file.seek(at)
        return cbor2.loads(self._file.read(size))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _scan(self) -> int:
        """Note every whole record; returns where the next goes."""
        if self._file.read(len(MAGIC)) != MAGIC:
            self._file.seek(0)
            self._file.truncate()
            self._file.write(MAGIC)
            self._file.flush()
            return len(MAGIC)
        at = len(MAGIC)
        while len(frame := self._file.read(FRAME.size)) == FRAME.size:
            size, crc, key_size = FRAME.unpack(frame)
            if key_size > size or size > MAX_RECORD_BYTES:
                break
            payload = self._file.read(size)
            if len(payload) < size or zlib.crc32(payload) != crc:
                break
            key = payload[:key_size].decode("utf-8", "replace")
            self._where[key] = (at + FRAME.size + key_size, size - key_size)
            at += FRAME.size + size
        return at
