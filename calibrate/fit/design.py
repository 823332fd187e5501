"""A fixed order of a grid's cells in which the first few already describe any brush well."""

from __future__ import annotations

import numpy as np

from calibrate.spread import farthest_first

Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""


def spread_out(heights_mm: list[float], tilts_deg: list[float]) -> list[Cell]:
    """Every cell once, each as far as possible from those before it (`calibrate.spread`).

    Both axes are scaled to the range of the grid. The first cell is the shallowest at the least tilt.
    """
    cells = [(height, tilt) for height in heights_mm for tilt in tilts_deg]
    places = np.array([(_share(height, heights_mm), _share(tilt, tilts_deg)) for height, tilt in cells])
    return [cells[k] for k in farthest_first(places, cells.index(min(cells)), len(cells))]


def _share(value: float, axis: list[float]) -> float:
    low, high = min(axis), max(axis)
    return (value - low) / (high - low) if high > low else 0.0
