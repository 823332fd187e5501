"""The limits of the quality checks that a twin brings with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.fit.captures import grid_of
from brushloop.collect.rig.config_quality import QualityConfig
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush_file import PAPER, load_brush
from brushloop.twin.run import LEAST_MISPLACED_MM, sound_head

GRID = grid_of(Field())
CELLS = [(11.0, 0.0), (20.0, 0.0), (11.0, 10.0), (20.0, 10.0)]


def test_other_presses_of_a_brush_begin_where_its_twin_says() -> None:
    brush = Brush(load_brush(Path(PAPER)).spec)
    head = sound_head(brush.spec, CELLS, GRID)
    assert head is not None
    for depth_mm, tilt_deg in CELLS:
        mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=7)
        columns = np.flatnonzero((mark.density > 0.5).any(axis=0))
        begins_mm = (columns[-1] + 1 - mark.origin_px[0]) / mark.px_per_mm
        assert abs(begins_mm - head.head_mm) < head.misplaced_mm - 0.5


def test_the_default_brush_keeps_the_default_limit() -> None:
    head = sound_head(BrushSpec(), CELLS, GRID)
    assert head is not None
    assert head.misplaced_mm == LEAST_MISPLACED_MM == QualityConfig().misplaced_mm
    assert head.head_mm == pytest.approx(QualityConfig().head_mm, abs=0.3)


def test_without_ink_in_view_there_is_nothing_to_set() -> None:
    elsewhere = replace(GRID, y_mm=GRID.y_mm + 50.0)
    assert sound_head(BrushSpec(), CELLS[:1], elsewhere) is None
