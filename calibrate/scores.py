"""The one table of scores: every comparison of a captured stroke with an image, in memory.

Tables 1 and 2, CSV, Parquet, gates and figures are queries on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import KEYS, Alignment, Key, Tone
from brushloop.sessions.records import Condition

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Score:
    """Similarity, from 0 to 1, of one captured stroke and what a model predicts for it."""

    session: str
    stroke_id: str
    condition: Condition
    """As commanded."""
    reached_mm: float | None
    """Depth that the arm reached; None where the recording does not say."""
    model: str
    """The model, or the kind of press that the stroke is compared with."""
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float


class Scores:
    """CSIM and SSIM, from 0 to 1, of every stroke and model; NaN where there is nothing to compare with."""

    def __init__(self, strokes: int, models: Sequence[str]) -> None:
        self.models = tuple(models)
        self._values = np.full((strokes, len(models), len(KEYS), 2), np.nan)

    def put(self, strokes: NDArray[np.int64], models: NDArray[np.int64], values: Values) -> None:
        """Enter (strokes, models, KEYS, 2) values; both are numbers of rows of the table."""
        self._values[np.ix_(strokes, models)] = values

    def of(self, model: str) -> Values:
        """(strokes, KEYS, 2) scores of one model."""
        return self._values[:, self.models.index(model)]

    def of_stroke(self, stroke: int) -> Values:
        """(models, KEYS, 2) scores of one stroke."""
        return self._values[stroke]

    def one(self, stroke: int, model: str, key: Key) -> tuple[float, float]:
        """CSIM and SSIM of one stroke by one model."""
        csim, ssim = self._values[stroke, self.models.index(model), KEYS.index(key)]
        return float(csim), float(ssim)
