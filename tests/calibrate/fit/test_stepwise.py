import subprocess
import sys

import numpy as np
import pytest

from calibrate.fit.stepwise import next_press
from calibrate.fit.strokes import Grid
from model.fitted import FittedPress
from tests.waiting import PATIENCE_S

GRID = Grid((np.arange(80) + 0.5) * 0.5 - 31.0, 8.0 - (np.arange(32) + 0.5) * 0.5)
CELLS = [(h, a) for h in (11.0, 13.0, 15.0, 17.0, 20.0) for a in (0.0, 5.0, 10.0)]
BRUSH = FittedPress(6.0, 48.0)


def test_every_press_leaves_less_to_be_won_and_the_grid_is_spanned() -> None:
    done: list[tuple[float, float]] = []
    points: list[float] = []
    for _ in range(5):
        choice = next_press(BRUSH, done, CELLS, GRID, enough_points=0.0)
        assert choice.cell is not None
        assert choice.points_after < choice.points
        done.append(choice.cell)
        points.append(choice.points)
    assert points == sorted(points, reverse=True)
    assert len({h for h, _ in done}) >= 2
    assert len({a for _, a in done}) >= 2


def test_it_stops_when_little_is_left_and_says_what_that_saved() -> None:
    done = [CELLS[0], CELLS[2], CELLS[7], CELLS[12], CELLS[14]]
    choice = next_press(BRUSH, done, CELLS, GRID, enough_points=50.0, whole_grid=150)
    assert choice.cell is None
    assert choice.saved == 145
    assert next_press(BRUSH, done[:2], CELLS, GRID, enough_points=50.0).cell is not None, "fewer than three presses"


def test_it_is_pure() -> None:
    assert next_press(BRUSH, CELLS[:2], CELLS, GRID) == next_press(BRUSH, CELLS[:2], CELLS, GRID)


def test_no_candidates_is_an_error() -> None:
    with pytest.raises(ValueError, match="no cell"):
        next_press(BRUSH, [], [], GRID)


def test_a_rig_needs_no_torch_for_it() -> None:
    code = "import sys, calibrate.fit.stepwise; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE_S).returncode == 0
