"""Presses of a described brush on the grid of the captured ones."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.fit.captures import Grid
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.twin.constants import Offset
from brushloop.twin.drawing import draw, mechanics, still

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))
HERE = Offset(0.0, 0.0, 0.0)


def middle_mm(ink: np.ndarray) -> tuple[float, float]:
    return float((ink.sum(axis=0) * GRID.x_mm).sum() / ink.sum()), float(
        (ink.sum(axis=1) * GRID.y_mm).sum() / ink.sum()
    )


def test_a_mark_has_the_area_and_the_place_of_the_press_that_it_stands_for() -> None:
    ink = draw(BrushSpec(), HERE, [(4.0, 5.0)], GRID)[0, 0]
    mark = Brush(BrushSpec()).press(4.0, 5.0, ink_load=1.0, press_seed=0, px_per_mm=5.0)
    inked = mark.density > 0.3
    assert ink.sum() * GRID.px_mm**2 == pytest.approx(inked.sum() / 25.0, rel=0.01)
    rows, columns = np.nonzero(inked)
    x, y = (columns + 0.5 - mark.origin_px[0]) / 5.0, (mark.origin_px[1] - rows - 0.5) / 5.0
    assert middle_mm(ink) == pytest.approx((x.mean(), y.mean()), abs=0.03)


def test_an_offset_moves_the_mark_and_presses_deeper() -> None:
    here = draw(BrushSpec(), HERE, [(4.0, 0.0)], GRID)[0, 0]
    moved = draw(BrushSpec(), Offset(0.0, 1.0, 2.0), [(4.0, 0.0)], GRID)[0, 0]
    deeper = draw(BrushSpec(), Offset(0.5, 0.0, 0.0), [(4.0, 0.0)], GRID)[0, 0]
    assert np.subtract(middle_mm(moved), middle_mm(here)) == pytest.approx((1.0, 2.0), abs=0.03)
    assert deeper.sum() > here.sum()


def test_one_descent_serves_several_depths_as_a_press_of_each() -> None:
    brush = Brush(BrushSpec())
    ways = brush.descents([3.0, 4.5], 5.0)
    for depth, way in ways.items():
        assert way[-1].normal_n.sum() == pytest.approx(brush.push_n(depth, 5.0)[-1])
    with pytest.raises(ValueError, match="depth_mm = 90 is outside"):
        brush.descents([90.0], 0.0)


def test_ink_constants_and_the_spread_leave_the_mechanics_alone() -> None:
    assert mechanics(BrushSpec(film_mm=0.8, spread_wander=0.1, seed=4)) == mechanics(BrushSpec())
    assert mechanics(BrushSpec(friction=0.3)) != mechanics(BrushSpec())
    assert still(BrushSpec()).reach_wander_mm == 0.0
