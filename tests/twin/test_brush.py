"""The brush of a twin: its constants in scales from their defaults, and its presses on the captures' grid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.fit.captures import Grid, grid_of
from brushloop.collect.rig.config_quality import QualityConfig
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.spec import ALLOWED, PAPER, load_brush
from brushloop.twin.brush import (
    SHAPE,
    SPREAD,
    Constant,
    Offset,
    brush_at,
    draw,
    mechanics,
    offset_at,
    search_bounds,
    with_values,
)
from brushloop.twin.run import LEAST_MISPLACED_MM, sound_head

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))
HERE = Offset(0.0, 0.0, 0.0)


@given(st.sampled_from([*SHAPE, *SPREAD]), st.floats(-8.0, 8.0))
def test_a_value_is_one_that_the_brush_allows_and_lies_where_it_says(one: Constant, scales: float) -> None:
    low, high = ALLOWED[one.name]
    value = one.value(scales)
    assert low <= value <= high
    if low < value < high:
        assert one.scales(value) == pytest.approx(scales, abs=1e-6)


def test_the_middle_of_the_search_is_the_default_brush_of_the_captured_size() -> None:
    base = BrushSpec(radius_mm=5.0, length_mm=40.0, seed=3)
    middle = np.zeros(len(SHAPE) + 3)
    low, high = search_bounds()
    assert brush_at(middle, base) == base
    assert offset_at(middle) == HERE
    assert np.all((low < middle) & (middle <= high))
    spread = with_values(BrushSpec(friction=0.3), SPREAD, [1.0] + [0.0] * (len(SPREAD) - 1))
    assert (spread.friction, spread.spread_wander) == (0.3, pytest.approx(BrushSpec().spread_wander * np.exp(0.7)))


def middle_mm(ink: np.ndarray) -> tuple[float, float]:
    x, y = (ink.sum(axis=0) * GRID.x_mm).sum(), (ink.sum(axis=1) * GRID.y_mm).sum()
    return float(x / ink.sum()), float(y / ink.sum())


def test_a_mark_has_the_area_and_the_place_of_the_press_that_it_stands_for() -> None:
    ink = draw(BrushSpec(), HERE, [(4.0, 5.0)], GRID)[0, 0]
    mark = Brush(BrushSpec()).press(4.0, 5.0, ink_load=1.0, press_seed=0, px_per_mm=5.0)
    inked = mark.density > 0.3
    assert ink.sum() * GRID.px_mm**2 == pytest.approx(inked.sum() / 25.0, rel=0.01)
    rows, columns = np.nonzero(inked)
    x, y = (columns + 0.5 - mark.origin_px[0]) / 5.0, (mark.origin_px[1] - rows - 0.5) / 5.0
    assert middle_mm(ink) == pytest.approx((x.mean(), y.mean()), abs=0.03)


def test_an_offset_moves_the_mark_and_presses_deeper() -> None:
    here, moved, deeper = (
        draw(BrushSpec(), offset, [(4.0, 0.0)], GRID)[0, 0]
        for offset in (HERE, Offset(0.0, 1.0, 2.0), Offset(0.5, 0.0, 0.0))
    )
    assert np.subtract(middle_mm(moved), middle_mm(here)) == pytest.approx((1.0, 2.0), abs=0.03)
    assert deeper.sum() > here.sum()


def test_ink_constants_and_the_spread_leave_the_mechanics_alone() -> None:
    assert mechanics(BrushSpec(film_mm=0.8, spread_wander=0.1, seed=4)) == mechanics(BrushSpec())
    assert mechanics(BrushSpec(friction=0.3)) != mechanics(BrushSpec())


def test_the_quality_limits_hold_for_other_presses_of_the_brush() -> None:
    grid, cells = grid_of(Field()), [(11.0, 0.0), (20.0, 0.0), (11.0, 10.0), (20.0, 10.0)]
    brush = Brush(load_brush(Path(PAPER)).spec)
    head = sound_head(brush.spec, cells, grid)
    assert head is not None
    for depth_mm, tilt_deg in cells:
        mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=7)
        columns = np.flatnonzero((mark.density > 0.5).any(axis=0))
        begins_mm = (columns[-1] + 1 - mark.origin_px[0]) / mark.px_per_mm
        assert abs(begins_mm - head.head_mm) < head.misplaced_mm - 0.5
    default = sound_head(BrushSpec(), cells, grid)
    assert default is not None
    assert default.misplaced_mm == LEAST_MISPLACED_MM == QualityConfig().misplaced_mm
    assert default.head_mm == pytest.approx(QualityConfig().head_mm, abs=0.3)
    assert sound_head(BrushSpec(), cells[:1], replace(grid, y_mm=grid.y_mm + 50.0)) is None
