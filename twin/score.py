"""How well a twin predicts cells that it was not fitted to, beside the ceiling and the refitted Bezier.

The cells are divided into three parts, each of which holds some of every depth and tilt; a twin fitted to two parts
predicts the third.
"""

from __future__ import annotations

from collections.abc import Sequence

from brushloop.calibrate.fit.captures import Grid
from brushloop.calibrate.fit.heldout import Images
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.twin.constants import Offset
from brushloop.twin.drawing import Cell, draw

PARTS = 3
TWIN = "twin"
VOTES = 7
"""Presses of the twin that are averaged to one prediction."""
FIRST_SEED = 900


def parts_of(cells: Sequence[Cell]) -> list[list[int]]:
    """Numbers of the cells in each part, along the diagonals of the grid of depths and tilts."""
    heights, tilts = sorted({h for h, _ in cells}), sorted({a for _, a in cells})
    diagonal = [(heights.index(h) + tilts.index(a)) % PARTS for h, a in cells]
    parts = [[k for k, at in enumerate(diagonal) if at == part] for part in range(PARTS)]
    return [part for part in parts if part and len(part) < len(cells)]


def predicted(spec: BrushSpec, offset: Offset, cells: Sequence[Cell], grid: Grid) -> dict[Cell, Images]:
    """Mean ink of several presses of the twin in each cell."""
    drawn = draw(spec, offset, cells, grid, VOTES, FIRST_SEED)
    return dict(zip(cells, drawn.mean(axis=1), strict=True))
