"""The compared strokes of a run and their scores: both stay in the store, and memory holds where they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.field import KEYS
from brushloop.calibrate.validate.jobs import Press, Values, press_of
from brushloop.calibrate.validate.store import Store

Cell = tuple[float, float]
"""(H, alpha) as commanded."""
Entry = tuple[int, int, float, float, bool]
INDEX = np.dtype(
    [("session", "i4"), ("number", "i4"), ("depth_mm", "f8"), ("tilt_deg", "f8"), ("cut", "?")],
)
"""A row: number of its session, of its stroke in order of capture, its cell, whether the photograph cuts it."""
CHUNK = 16
"""Most strokes in one record of scores; all are of one cell of one session."""
Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Row:
    """A compared stroke."""

    session: int
    press: Press
    """Without its pixels."""

    @property
    def cell(self) -> Cell:
        """(H, alpha) as commanded."""
        return self.press.depth_mm, self.press.tilt_deg


class Rows:
    """Compared strokes by session and order of capture; each is read from the store when it is asked for."""

    def __init__(self, store: Store, keys: Sequence[str], entries: Iterable[Entry]) -> None:
        """`keys` holds, for each session, the beginning of the keys of its prepared strokes."""
        self._store = store
        self._keys = keys
        self.index: NDArray[Any] = np.fromiter(entries, INDEX)
        """(rows,) of `INDEX`."""
        cells = np.stack([self.index[name].astype(np.float64) for name in ("session", "depth_mm", "tilt_deg")], axis=1)
        _, stratum = np.unique(cells, axis=0, return_inverse=True)
        self.stratum: Numbers = stratum.reshape(-1)
        """(rows,) number of each row's cell and session, in their order."""
        self.order: Numbers = np.argsort(self.stratum, kind="stable")
        """(rows,) rows sorted by stratum, then by order of capture."""

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, row: int) -> Row:
        return Row(self.session(row), press_of(self._body(row) | {"pixels": b""}))

    def __iter__(self) -> Iterator[Row]:
        return (self[row] for row in range(len(self)))

    def pixels(self, row: int) -> bytes:
        """`Press.pixels` of a row."""
        return self._body(row)["pixels"]

    def cell(self, row: int) -> Cell:
        """(H, alpha) of a row."""
        return float(self.index[row]["depth_mm"]), float(self.index[row]["tilt_deg"])

    def session(self, row: int) -> int:
        """Number of a row's session."""
        return int(self.index[row]["session"])

    def groups(self) -> Iterator[tuple[int, Cell, Numbers]]:
        """Yield session, cell and its rows in order of capture, sorted by session and cell."""
        ends = np.flatnonzero(np.diff(self.stratum[self.order], append=-1)) + 1
        start = 0
        for end in map(int, ends):
            group = self.order[start:end]
            yield self.session(int(group[0])), self.cell(int(group[0])), group
            start = end

    def of_cell(self, cell: Cell) -> Numbers:
        """Rows of a cell in any session, by session and order of capture."""
        return np.flatnonzero((self.index["depth_mm"] == cell[0]) & (self.index["tilt_deg"] == cell[1]))

    def first_of_cells(self) -> dict[Cell, int]:
        """The first row of each cell, sorted by cell."""
        first: dict[Cell, int] = {}
        for _, cell, group in self.groups():
            first.setdefault(cell, int(group[0]))
        return dict(sorted(first.items()))

    def _body(self, row: int) -> dict[str, Any]:
        entry = self.index[row]
        return self._store.get(f"{self._keys[entry['session']]}:{entry['number']}")


class Scores:
    """CSIM and SSIM from 0 to 1 of every row and name; NaN where there is nothing to compare with."""

    def __init__(self, store: Store, rows: Rows, names: Sequence[str], columns: Sequence[Sequence[int]]) -> None:
        """`columns` holds, for each session, the number in `names` of each model in its records."""
        self._store = store
        self._rows = rows
        self._names = names
        self._columns = columns
        self._place = np.empty(len(rows), np.int64)
        self._place[rows.order] = np.arange(len(rows))
        self._starts: list[int] = []
        self._keys: list[str] = []

    def add(self, chunk: Numbers, key: str) -> None:
        """The record `key` of the store holds the scores of these rows, which follow those of the call before."""
        self._starts.append(int(self._place[chunk[0]]))
        self._keys.append(key)

    def of(self, name: str) -> Values:
        """(rows, KEYS, 2) scores of one model."""
        number = self._names.index(name)
        out = np.full((len(self._rows), len(KEYS), 2), np.nan)
        ends = [*self._starts, len(self._rows)][1:]
        for key, start, end in zip(self._keys, self._starts, ends, strict=True):
            chunk = self._rows.order[start:end]
            columns = self._columns[self._rows.session(int(chunk[0]))]
            if number in columns:
                out[chunk] = self._record(key)[:, columns.index(number)]
        return out

    def of_row(self, row: int) -> Values:
        """(names, KEYS, 2) scores of one row."""
        place = int(self._place[row])
        record = int(np.searchsorted(self._starts, place, side="right")) - 1
        out = np.full((len(self._names), len(KEYS), 2), np.nan)
        out[self._columns[self._rows.session(row)]] = self._record(self._keys[record])[place - self._starts[record]]
        return out

    def _record(self, key: str) -> Values:
        body = self._store.get(key)
        return np.frombuffer(body["values"]).reshape(body["shape"])
