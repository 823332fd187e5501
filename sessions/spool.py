"""A sequence too long for memory: what is beyond a few kilobytes waits in a temporary file."""

from __future__ import annotations

import io
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

IN_MEMORY_BYTES = 64 * 1024
_T = TypeVar("_T")


class Spool(Generic[_T]):
    """Items kept as lines of text; each walk reads them again. Raises OSError where the temporary disk is full.

    `dumps` makes one line of an item, as JSON does, and `loads` the item of the line.
    """

    def __init__(self, dumps: Callable[[_T], str], loads: Callable[[str], _T], items: Iterable[_T] = ()) -> None:
        self._dumps, self._loads = dumps, loads
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._count = 0
        for item in items:
            self.append(item)

    def append(self, item: _T) -> None:
        """Add an item at the end."""
        self._file.seek(0, io.SEEK_END)  # a walk that was broken off leaves the file in its middle
        self._file.write(self._dumps(item).encode() + b"\n")
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[_T]:
        at = 0
        while True:
            self._file.seek(at)  # another walk may have moved it
            lines = self._file.readlines(IN_MEMORY_BYTES)
            at = self._file.tell()
            if not lines:
                return
            for line in lines:
                yield self._loads(line.decode())
