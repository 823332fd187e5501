"""A practice sheet: strokes that show how a brush is dragged, to fit its footprint before the first character.

Lines, bends and sharp turns at changing depths, in all directions. They are drawn at random from a seed and do not
depend on any character, so a plan that is made with their fit has learned nothing from the character itself.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.field import SIZE_PX
from brushloop.calibrate.writing.plan_files import figure_record, write_record
from brushloop.calibrate.writing.plan_record import FigureRecord, PlannedBy, PlanRecord
from brushloop.model.characters.brush import Reach
from brushloop.model.characters.plan import directions

Floats = NDArray[np.float64]
FIGURES, PER_FIGURE = 10, 2
MARGIN = 0.22
"""Share of the cell at each side that is kept free: ink lands behind its command, and must not reach the edge."""
DEEPEST = 0.3
"""Greatest depth as a share of the brush's length."""
MM_BETWEEN = 2.0
TILT_DEG = 5.0
NAME = "practice"


def practice_strokes(side_mm: float, reach: Reach, brush_length_mm: float, seed: int = 1) -> list[Floats]:
    """`FIGURES` x `PER_FIGURE` trajectories (N, 5) on a cell of that side; every third has a sharp turn.

    None is deeper than `DEEPEST` of the brush's length.
    """
    rng = np.random.default_rng(seed)
    deepest_mm = min(reach.depth_mm[1], math.floor(DEEPEST * brush_length_mm))
    room_mm = (1.0 - 2.0 * MARGIN) * side_mm
    out: list[Floats] = []
    while len(out) < FIGURES * PER_FIGURE:
        length_mm = rng.uniform(0.2, 1.0) * room_mm
        count = max(4, round(length_mm / MM_BETWEEN))
        heading = rng.uniform(-180.0, 180.0) + np.cumsum(rng.normal(0.0, 8.0, count))
        if len(out) % 3 == 0:
            heading[count // 2 :] += rng.choice([-1.0, 1.0]) * rng.uniform(50.0, 150.0)
        places = np.cumsum(directions(heading) * length_mm / count, axis=0)
        low, high = places.min(axis=0), places.max(axis=0)
        places += MARGIN * side_mm - low + rng.uniform(0.0, 1.0, 2) * np.maximum(room_mm - (high - low), 0.0)
        depths = rng.uniform(0.1, 1.0, 3) * deepest_mm
        depth = np.interp(np.linspace(0.0, 1.0, count), (0.0, 0.5, 1.0), depths)
        points = np.column_stack((places, depth, np.full(count, TILT_DEG), heading))
        made = reach.spaced(np.round(reach.within(points, side_mm), 3))
        if len(made) >= 3:
            out.append(made)
    return out


def write_practice(out: Path, cell_mm: float, by: PlannedBy, seed: int) -> Path:
    """Write the protocol of a practice sheet, each stroke on a cell of its own; returns its path. Raises OSError."""
    reach = Reach(by.depth_range_mm, by.tilt_range_deg, turn_deg_mm=by.turn_deg_mm)
    blank = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    figures: list[FigureRecord] = []
    strokes = practice_strokes(cell_mm, reach, by.length_mm, seed)
    for number in range(FIGURES):
        some = strokes[number * PER_FIGURE : (number + 1) * PER_FIGURE]
        source = f"practice strokes, seed {seed}"
        figures.append(figure_record(f"{NAME}-{number + 1:02d}", source, some, some, wanted=blank, simulated=blank))
    record = PlanRecord(
        model="none: practice", planned_by=by, cell_mm=cell_mm, software="brushloop", figures=tuple(figures)
    )
    out.mkdir(parents=True, exist_ok=True)
    return write_record(record, 1, out)
