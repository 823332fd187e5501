"""The search for a brush's mechanics and ink, on shallow presses, which are quick to draw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brushloop.calibrate.fit.captures import Grid
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.twin.constants import SHAPE, Offset
from brushloop.twin.drawing import draw
from brushloop.twin.shape import Round, Target, choose_individual, derivatives, of_parts, off, search, start
from tests.twin.serial import Serial

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))
CELLS = ((3.0, 0.0), (4.0, 5.0))
BASE = BrushSpec(seed=0)


@pytest.fixture(scope="module")
def target() -> Target:
    """The mean press of a brush that gives ink from higher over the paper than the default."""
    ink = draw(replace(BASE, film_mm=1.0), Offset(0.0, 0.4, 0.0), CELLS, GRID, repeats=2, first_seed=50)
    return Target(BASE, CELLS, GRID, ink.mean(axis=1))


def test_derivatives_of_a_line_are_its_slopes_also_at_the_upper_bound() -> None:
    slopes = np.array([[1.0, 2.0], [3.0, -4.0]])
    found = derivatives(lambda at: slopes @ at, np.array([0.0, 1.0]), np.array([5.0, 1.0]), 0.1)
    assert found == pytest.approx(slopes)


def test_a_search_comes_nearer_to_the_captures(target: Target) -> None:
    before, ticks = start(), list[int]()
    after = search(target, before, Round(0.5, 2), Serial(), lambda: ticks.append(1))
    squares = [float((off(target, 0, 0.5, one.point) ** 2).sum()) for one in (before, after)]
    assert squares[1] < 0.5 * squares[0]
    names = [one.name for one in SHAPE]
    assert after.point[names.index("film_mm")] > 0.2
    assert len(ticks) >= 1


def test_the_individual_nearest_to_the_captures_is_chosen(target: Target, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brushloop.twin.shape.INDIVIDUALS", range(4))
    ink = draw(replace(BASE, seed=2), Offset(0.0, 0.0, 0.0), CELLS, GRID)
    assert choose_individual(replace(target, mean=ink[:, 0]), start(), Serial()).seed == 2


def test_what_the_parts_disagree_on_is_uncertain() -> None:
    points = [np.array([1.0, 0.0]), np.array([1.0, 3.0]), np.array([1.0, -3.0])]
    assert of_parts(points) == pytest.approx([0.0, 2.0 / 3.0 * 18.0])
    assert of_parts(points[:1]) == 0.0
