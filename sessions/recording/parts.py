"""The chunks of a recording that a scan has found, kept in little memory."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Part:
    """One chunk of a file, readable or not."""

    offset: int
    counts: Counter[str] | None
    """Number of messages by topic; None if unknown."""
    sound: bool
    """Whether it can be read and matches its CRC."""


class Parts:
    """The chunks of a file, 16 bytes for each; nearly all of them hold the same numbers of messages."""

    def __init__(self) -> None:
        self._offsets = array("Q")
        self._kinds: list[Part] = []
        """For each chunk, a part that equals it but for its offset."""
        self._known: dict[tuple[bool, frozenset[tuple[str, int]] | None], Part] = {}

    def append(self, part: Part) -> None:
        """Add a chunk."""
        kind = part.sound, None if part.counts is None else frozenset(part.counts.items())
        self._offsets.append(part.offset)
        self._kinds.append(self._known.setdefault(kind, part))

    def __len__(self) -> int:
        return len(self._offsets)

    def __iter__(self) -> Iterator[Part]:
        return map(self._at, range(len(self)))

    def _at(self, at: int) -> Part:
        return replace(self._kinds[at], offset=self._offsets[at])
