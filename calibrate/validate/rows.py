"""The compared strokes of a run, in memory; their pixels stay in the store."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.validate.jobs import Press
from brushloop.calibrate.validate.store import Store
from brushloop.sessions.records import Condition

Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Row:
    """A compared stroke."""

    session: int
    key: str
    """Of the prepared press in the store."""
    press: Press
    """Without its pixels."""


class Rows:
    """Compared strokes by session and order of capture, and groups of those with one condition in one session."""

    def __init__(self, store: Store, rows: Iterable[Row]) -> None:
        self._store = store
        self._rows = tuple(rows)
        self.session: Numbers = np.array([row.session for row in self._rows], np.int64)
        self.cut = np.array([row.press.cut for row in self._rows], np.bool_)
        """(rows,) whether the photograph cuts the stroke."""
        groups: dict[tuple[int, Condition], list[int]] = {}
        for number, row in enumerate(self._rows):
            groups.setdefault((row.session, row.press.condition), []).append(number)
        self.groups = [(*key, np.array(groups[key], np.int64)) for key in sorted(groups)]
        """Session, condition and rows in order of capture, sorted by session and condition."""
        self.stratum: Numbers = np.zeros(len(self._rows), np.int64)
        """(rows,) number of each row's group."""
        for number, (_, _, group) in enumerate(self.groups):
            self.stratum[group] = number

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, row: int) -> Row:
        return self._rows[row]

    def __iter__(self) -> Iterator[Row]:
        return iter(self._rows)

    def pixels(self, row: int) -> bytes:
        """`Press.pixels` of a row, read from the store."""
        return self._store.get(self._rows[row].key)["pixels"]

    def of_condition(self, condition: Condition) -> Numbers:
        """Rows of a condition in any session, by session and order of capture."""
        found = [group for _, one, group in self.groups if one == condition]
        return np.concatenate(found)

    def first_of_each(self) -> dict[Condition, int]:
        """The first row of each condition, sorted by condition."""
        first: dict[Condition, int] = {}
        for _, condition, group in self.groups:
            first.setdefault(condition, int(group[0]))
        return dict(sorted(first.items()))
