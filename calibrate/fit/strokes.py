"""The data of a fit: captured presses as images around the point of touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SPREAD_MM = 0.15
"""Variation of an edge from press to press (scale of a logistic)."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixel centres of an image around the point of touch, mm: x toward the heel, y upward."""

    x_mm: Floats
    y_mm: Floats

    @property
    def px_mm(self) -> float:
        """The pixel's side."""
        return float(self.x_mm[1] - self.x_mm[0])


@dataclass(frozen=True, slots=True)
class Pressed:
    """One captured press: its command and its ink, (len(y_mm), len(x_mm)) from 0 to 1."""

    height_mm: float
    tilt_deg: float
    ink: NDArray[np.floating]
