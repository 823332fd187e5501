"""The ink well: a straight pot whose level falls with every dip and rises with every dose."""

from __future__ import annotations

import math

BRUSH_ML = 0.5
"""What a dry brush takes up."""


class Well:
    """Ink in a pot whose bottom is at height 0."""

    def __init__(self, ml: float, capacity_ml: float, ml_per_mm: float = 1.0) -> None:
        self.ml = ml
        self.capacity_ml = capacity_ml
        self._ml_per_mm = ml_per_mm

    @classmethod
    def round(cls, radius_mm: float, level_mm: float, depth_mm: float) -> Well:
        """A round pot that is `depth_mm` deep, filled to `level_mm`."""
        ml_per_mm = math.pi * radius_mm**2 / 1e3
        return cls(level_mm * ml_per_mm, depth_mm * ml_per_mm, ml_per_mm)

    @property
    def level_mm(self) -> float:
        """Height of the ink above the bottom."""
        return self.ml / self._ml_per_mm

    @property
    def share(self) -> float:
        """Filling, 0 to 1."""
        return min(1.0, self.ml / self.capacity_ml)

    def add(self, volume_ml: float) -> None:
        """A dose; what does not fit runs over."""
        self.ml = min(self.capacity_ml, self.ml + volume_ml)

    def dip(self, ink_load: float) -> float:
        """Fill a brush that holds `ink_load` (0 to 1); returns what it holds then."""
        taken_ml = min(self.ml, (1.0 - ink_load) * BRUSH_ML)
        self.ml -= taken_ml
        return ink_load + taken_ml / BRUSH_ML
