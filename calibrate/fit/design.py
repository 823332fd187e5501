"""The order in which the cells of a grid tell most about a brush, whatever the brush: a fixed design."""

from __future__ import annotations

import math

Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""


def spread_out(heights_mm: list[float], tilts_deg: list[float]) -> list[Cell]:
    """Every cell once, each as far as possible from those before it: a maximin design that can stop anywhere.

    Both axes are scaled to the range of the grid. The first cell is the shallowest at the least tilt; of equally
    distant cells, the first in the grid's order follows (R. Kennard and L. Stone, "Computer aided design of
    experiments", 1969).
    """
    cells = [(height, tilt) for height in heights_mm for tilt in tilts_deg]
    places = {cell: (_share(cell[0], heights_mm), _share(cell[1], tilts_deg)) for cell in cells}
    order = [min(cells)]
    while len(order) < len(cells):
        done = [places[cell] for cell in order]
        left = [cell for cell in cells if cell not in order]
        order.append(max(left, key=lambda cell: round(min(math.dist(places[cell], one) for one in done), 9)))
    return order


def _share(value: float, axis: list[float]) -> float:
    low, high = min(axis), max(axis)
    return (value - low) / (high - low) if high > low else 0.0
