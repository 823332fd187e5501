"""The one table of scores: every comparison of a captured press with an image, in memory.

Tables 1 and 2, CSV, Parquet, gates and figures are queries on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import KEYS, Alignment, Key, Pixels, Tone, unpack
from brushloop.calibrate.stroke.measure import Measured
from brushloop.sessions.records import Condition, Stroke

Values = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Score:
    """Similarity, from 0 to 1, of one captured press and what a model predicts for it."""

    session: str
    stroke_id: str
    condition: Condition
    """As commanded."""
    reached_mm: float | None
    """Depth that the arm reached; None where the recording does not say."""
    model: str
    """The model, or the kind of press that the press is compared with."""
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float


@dataclass(frozen=True, slots=True)
class Row:
    """A press in the table."""

    session: str
    stroke: Stroke
    condition: Condition
    """As commanded."""
    measured: Measured
    cut: bool
    packed: bytes
    """`pack` of (len(KEYS) + 1, 128, 128): an image for each key, then the coverage on the millimetre field."""

    def image(self, key: Key) -> Pixels:
        """(128, 128) as it was captured."""
        return unpack(self.packed)[KEYS.index(key)]


class Scores:
    """CSIM and SSIM, from 0 to 1, of every press and model; NaN where there is nothing to compare with."""

    def __init__(self, rows: Sequence[Row], models: Sequence[str]) -> None:
        self.rows, self.models = tuple(rows), tuple(models)
        """Presses by session and order of capture, and names of models."""
        self.values = np.full((len(rows), len(models), len(KEYS), 2), np.nan)
        cells: dict[tuple[int, Condition], list[int]] = {}
        order = {name: number for number, name in enumerate(dict.fromkeys(row.session for row in rows))}
        for number, row in enumerate(rows):
            cells.setdefault((order[row.session], row.condition), []).append(number)
        self.cells = [np.array(cells[key], np.int64) for key in sorted(cells)]
        """Rows of each cell, which is one condition in one session, by session and condition."""
        self.cell_of: Numbers = np.zeros(len(rows), np.int64)
        """(rows,) number of each row's cell."""
        for number, cell in enumerate(self.cells):
            self.cell_of[cell] = number

    def __iter__(self) -> Iterator[Score]:
        """The scores by session, order of capture and model; those that are missing are left out."""
        for row, of_row in zip(self.rows, self.values, strict=True):
            about = (row.session, row.stroke.stroke_id, row.condition, row.stroke.reached_mm)
            for model, values in zip(self.models, of_row.tolist(), strict=True):
                for key, (csim, ssim) in zip(KEYS, values, strict=True):
                    if math.isfinite(csim):
                        yield Score(*about, model, *key, csim, ssim)

    def of(self, model: str) -> Values:
        """(rows, KEYS, 2) scores of one model."""
        return self.values[:, self.models.index(model)]

    def of_key(self, model: str, key: Key) -> Values:
        """(rows, 2) CSIM and SSIM of one model in one alignment and tone."""
        return self.of(model)[:, KEYS.index(key)]

    def conditions(self) -> dict[Condition, Numbers]:
        """Rows of each condition in any session, sorted by condition."""
        found: dict[Condition, list[Numbers]] = {}
        for cell in self.cells:
            found.setdefault(self.rows[int(cell[0])].condition, []).append(cell)
        return {condition: np.concatenate(found[condition]) for condition in sorted(found)}
