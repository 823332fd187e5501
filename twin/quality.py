"""Where the marks of a twin begin, for the quality checks of a session that is collected with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brushloop.calibrate.fit.captures import Grid
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.drivers.sim.config import SoundHead
from brushloop.twin.constants import Offset
from brushloop.twin.drawing import Cell, Images, draw

PRESSES = 3
"""Presses of each cell."""
FIRST_SEED = 300
MARGIN_MM = 0.8
"""How far the head of a sound mark may lie from where it lay in these presses: the touch point is off by up to 0.5 mm,
and other presses differ."""
LEAST_MISPLACED_MM = 1.6
"""The limit of the quality checks by default: a smaller one is not needed."""


def sound_head(spec: BrushSpec, cells: Sequence[Cell], grid: Grid) -> SoundHead | None:
    """The settings of the quality checks with which presses of the twin in these cells pass; None without ink."""
    drawn = draw(spec, Offset(0.0, 0.0, 0.0), cells, grid, PRESSES, FIRST_SEED)
    heads_mm = [at for cell in drawn for image in cell if (at := _head_mm(image, grid)) is not None]
    if not heads_mm:
        return None
    middle_mm = 0.5 * (min(heads_mm) + max(heads_mm))
    reach_mm = max(heads_mm) - middle_mm
    return SoundHead(round(middle_mm, 1), round(max(reach_mm + MARGIN_MM, LEAST_MISPLACED_MM), 1))


def _head_mm(image: Images, grid: Grid) -> float | None:
    """Where the mark begins along +x: its end near the point of touch, away from its tip."""
    columns = np.flatnonzero((image > 0.5).any(axis=0))
    if not columns.size:
        return None
    left, right = grid.x_mm[columns[0]] - 0.5 * grid.px_mm, grid.x_mm[columns[-1]] + 0.5 * grid.px_mm
    return float(-left if abs(left) < abs(right) else right)
