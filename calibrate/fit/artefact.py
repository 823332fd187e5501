"""The fitted brush on disk: an immutable file named after the hash of its contents, as a calibration is."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from calibrate.artefact import FittedValue, Frozen, SessionFit
from model.fitted import MODES, NAMES, TERMS, FittedPress

SCHEMA_VERSION = 1
FOLDER = "brushfit"
EARLIER_TERMS = 5


class FittedStage(Frozen):
    """A stage of the fit; `condition` is missing where it is infinite."""

    name: str
    condition: float | None
    refused: bool = False
    """Earlier versions refused a stage with a large condition number; its parameters have no interval there."""


class BrushFit(SessionFit):
    """A fitted brush, with its strokes and software. Equal inputs give an equal file."""

    schema_version: int = SCHEMA_VERSION
    radius_mm: float
    length_mm: float
    strokes: int
    cells: tuple[tuple[float, float], ...] = ()
    """Depth in mm and tilt in deg of the strokes, each cell once; missing in files of earlier versions."""
    mm_per_px: float
    parameters: dict[str, FittedValue]
    edges_mm: tuple[tuple[tuple[float, ...], ...], ...]
    ends_mm: tuple[tuple[float, ...], ...] = ((0.0,) * TERMS,) * 2
    """Missing in files of earlier versions, whose edges also lack the last term."""
    stages: tuple[FittedStage, ...]
    from_strokes: dict[str, float] = Field(default_factory=dict[str, float])
    """Share of each parameter's prior variance that the strokes removed; missing in earlier files."""
    proportional_h0_mm: float
    """Absolute zero offset, with every size held proportional to depth; see docs/brushfit.md."""
    proportional_h0_se_mm: float
    csim_percent: dict[str, float]
    """Leave-cell-out CSIM by model."""

    def press(self) -> FittedPress:
        """The fitted brush."""
        values = np.array([self.parameters[name].value for name in NAMES])
        edges = np.array(self.edges_mm)
        missing = TERMS - edges.shape[-1]
        edges = np.pad(edges, ((0, 0), (0, 0), (0, missing)))
        return FittedPress(self.radius_mm, self.length_mm, values, edges, np.array(self.ends_mm))

    @model_validator(mode="after")
    def _whole(self) -> Self:
        shapes = [(2, MODES, terms) for terms in (EARLIER_TERMS, TERMS)]
        edges, ends = np.array(self.edges_mm).shape, np.array(self.ends_mm).shape
        if set(self.parameters) != set(NAMES) or edges not in shapes or ends != (2, TERMS):
            raise ValueError(
                f"parameters: expected {', '.join(NAMES)}, edges of shape {shapes[-1]} and ends (2, {TERMS})"
            )
        return self
