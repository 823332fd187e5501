"""Drawings of the presses of a simulated brush, on the grid of the captured ones.

The descents of the last few brushes are remembered, because a search changes one constant at a time and half of them
leave the mechanics alone. Every press of a cell has the same seed for every brush: differences between brushes are then
not hidden by differences between presses (common random numbers).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.fit.captures import Grid
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Descent
from brushloop.drivers.sim.brush.paper import Footprint
from brushloop.twin.constants import INK, SPREAD, Offset

Cell = tuple[float, float]
"""(H in mm, alpha in deg)."""
Images = NDArray[np.float32]
PX_PER_MM = 5.0
"""Scale at which footprints are printed."""
INKED = 0.3
"""Density from which a place counts as inked, as in the loopback rig's own benches."""
FINE = 3
"""Each pixel of the grid is the mean of this many by this many samples."""
LEAST_MM = 0.5
REMEMBERED = 4
STILL = {"spread_wander": 0.0, "reach_wander_mm": 0.0, "bow_wander_mm": 0.0, "place_wander_mm": 0.0}
"""Values for a brush whose presses of a cell differ only by their paper."""


def draw(
    spec: BrushSpec, offset: Offset, cells: Sequence[Cell], grid: Grid, repeats: int = 1, first_seed: int = 0
) -> Images:
    """(cells, repeats, len(y_mm), len(x_mm)) ink from 0 to 1 of a freshly dipped brush.

    Raises ValueError, naming value and range, for a press deeper than the brush allows.
    """
    brush = Brush(spec)
    ways = _descents(mechanics(spec), offset.depth_mm, tuple(cells))
    ink = np.empty((len(cells), repeats, len(grid.y_mm), len(grid.x_mm)), np.float32)
    for c, way in enumerate(ways):
        for r in range(repeats):
            seed = first_seed + 1000 * c + r
            mark = brush.print_descent(way, ink_load=1.0, press_seed=seed, px_per_mm=PX_PER_MM)
            ink[c, r] = on_grid(mark, offset, grid)
    return ink


def still(spec: BrushSpec) -> BrushSpec:
    """The same brush without the spread of its presses."""
    return replace(spec, **STILL)


def mechanics(spec: BrushSpec) -> BrushSpec:
    """The brush with every constant that does not affect the bundle's shape at its default."""
    default = BrushSpec()
    return replace(spec, seed=0, **{one.name: getattr(default, one.name) for one in (*INK, *SPREAD)})


@lru_cache(maxsize=REMEMBERED)
def _descents(spec: BrushSpec, deeper_mm: float, cells: tuple[Cell, ...]) -> tuple[Descent, ...]:
    brush, found = Brush(spec), dict[Cell, Descent]()
    for tilt in {tilt for _, tilt in cells}:
        depths = {height: max(height + deeper_mm, LEAST_MM) for height, a in cells if a == tilt}
        ways = brush.descents(list(depths.values()), tilt)
        found |= {(height, tilt): ways[depth] for height, depth in depths.items()}
    return tuple(found[cell] for cell in cells)


def on_grid(mark: Footprint, offset: Offset, grid: Grid) -> Images:
    """(len(y_mm), len(x_mm)) share of each pixel that the mark inks."""
    ink = (mark.density > INKED).astype(np.float32)
    fine_mm = grid.px_mm / FINE
    scale = mark.px_per_mm * fine_mm
    first_x = float(grid.x_mm[0]) - 0.5 * grid.px_mm + 0.5 * fine_mm
    first_y = float(grid.y_mm[0]) + 0.5 * grid.px_mm - 0.5 * fine_mm
    column, row = mark.origin_px
    # from a fine pixel of the grid to a pixel of the footprint, whose centres lie half a pixel from its corner
    there = np.array(
        [
            [scale, 0.0, column - 0.5 + (first_x - offset.x_mm) * mark.px_per_mm],
            [0.0, scale, row - 0.5 + (offset.y_mm - first_y) * mark.px_per_mm],
        ]
    )
    size = (len(grid.x_mm), len(grid.y_mm))
    fine = cv2.warpAffine(ink, there, (FINE * size[0], FINE * size[1]), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.float32)
