"""How presses of one cell differ."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.fit.captures import Grid
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.twin.constants import SPREAD, Offset, with_values
from brushloop.twin.drawing import draw
from brushloop.twin.spread import Repeats, agreement, fit_spread, statistics

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))
CELLS = ((3.0, 0.0), (4.0, 5.0))
HERE = Offset(0.0, 0.0, 0.0)


def test_equal_repeats_agree_wholly_and_moved_ones_deviate_by_as_much_as_they_were_moved() -> None:
    one = draw(BrushSpec(), HERE, CELLS, GRID)[:, 0]
    moved = draw(BrushSpec(), Offset(0.0, 0.8, 0.0), CELLS, GRID)[:, 0]
    assert agreement([np.stack([a, a]) for a in one]) == pytest.approx(100.0)
    pairs = [np.stack([a, b]) for a, b in zip(one, moved, strict=True)]
    assert agreement(pairs) < 97.0
    assert np.exp(statistics(pairs, GRID)[1]) == pytest.approx(0.8 / np.sqrt(2.0), abs=0.15)


def test_presses_that_lie_elsewhere_are_not_taken_for_hairs_that_stray() -> None:
    captured = draw(BrushSpec(place_wander_mm=0.4), HERE, CELLS, GRID, repeats=6, first_seed=70)
    found = fit_spread(BrushSpec(), HERE, Repeats(CELLS, tuple(captured)), GRID)
    brush = with_values(BrushSpec(), SPREAD, found.point)
    assert brush.place_wander_mm == pytest.approx(0.4, abs=0.15)
    assert brush.strand_mm < 0.2


def test_a_brush_that_varies_more_gets_a_wider_spread() -> None:
    captured = draw(BrushSpec(reach_wander_mm=1.0), HERE, CELLS, GRID, repeats=6, first_seed=70)
    found = fit_spread(BrushSpec(), HERE, Repeats(CELLS, tuple(captured)), GRID)
    assert found.point[1] > 0.5
    assert found.twin_percent == pytest.approx(found.captured_percent, abs=6.0)  # small marks differ much
    with pytest.raises(ValueError, match="no cell has 3 captures"):
        fit_spread(BrushSpec(), HERE, Repeats((), ()), GRID)
