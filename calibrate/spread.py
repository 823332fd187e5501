"""The order in which points are each as far as possible from those before: a maximin design that can stop anywhere.

After R. Kennard and L. Stone, "Computer aided design of experiments" (1969).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""


def farthest_first(places: NDArray[np.float64], first: int, count: int) -> list[int]:
    """Rows of (n, d) `places` in that order, from the row `first`; of equally distant ones the upper row comes first.

    Raises ValueError unless there are `count` rows, at least one.
    """
    if not 1 <= count <= len(places):
        raise ValueError(f"count = {count}: allowed 1 to {len(places)}")
    order, nearest = [first], np.full(len(places), np.inf)
    while len(order) < count:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[order[-1]], axis=1))
        nearest[order] = -1.0
        order.append(int(np.round(nearest, 9).argmax()))
    return order


def spread_out(depths_mm: list[float], tilts_deg: list[float]) -> list[Cell]:
    """Every cell once, each as far as possible from those before it: the first few already describe any brush well.

    Both axes are scaled to the range of the grid. The first cell is the shallowest at the least tilt.
    """
    cells = [(height, tilt) for height in depths_mm for tilt in tilts_deg]
    places = np.array([(_share(height, depths_mm), _share(tilt, tilts_deg)) for height, tilt in cells])
    return [cells[k] for k in farthest_first(places, cells.index(min(cells)), len(cells))]


def _share(value: float, axis: list[float]) -> float:
    low, high = min(axis), max(axis)
    return (value - low) / (high - low) if high > low else 0.0
