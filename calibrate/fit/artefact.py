"""The fitted brush on disk: an immutable file named after the hash of its contents, as a calibration is."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import model_validator

from brushloop.calibrate.artefact import SessionFit
from brushloop.model.fitted import MODES, NAMES, TERMS, FittedPress

FOLDER = "brushfit"


class BrushFit(SessionFit):
    """A fitted brush, with its strokes and software. Equal inputs give an equal file."""

    radius_mm: float
    length_mm: float
    strokes: int
    cells: tuple[tuple[float, float], ...]
    """Depth in mm and tilt in deg of the strokes, each cell once."""
    mm_per_px: float
    parameters: dict[str, float]
    """They describe a mark together; on its own none is comparable between brushes. See docs/brushfit.md."""
    touch_errors_mm: tuple[tuple[float, float], ...]
    """Depth and place along the heading of the zero touch of each cell, for a fit to the others; empty for one cell."""
    edges_mm: tuple[tuple[tuple[float, ...], ...], ...]
    ends_mm: tuple[tuple[float, ...], ...]
    csim_percent: dict[str, float]
    """Leave-cell-out CSIM by model."""

    def press(self) -> FittedPress:
        """The fitted brush."""
        values = np.array([self.parameters[name] for name in NAMES])
        return FittedPress(self.radius_mm, self.length_mm, values, np.array(self.edges_mm), np.array(self.ends_mm))

    @model_validator(mode="after")
    def _whole(self) -> Self:
        shapes = (2, MODES, TERMS), (2, TERMS)
        found = tuple(np.array(value).shape for value in (self.edges_mm, self.ends_mm))
        if set(self.parameters) != set(NAMES) or found != shapes:
            raise ValueError(f"parameters: expected {', '.join(NAMES)}, with edges and ends of shapes {shapes}")
        return self
