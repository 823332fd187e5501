"""The search for a brush's mechanics, ink and spread, on shallow presses, which are quick to draw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brushloop.calibrate.fit.captures import Grid, Pressed
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.twin.brush import SHAPE, SPREAD, Offset, draw, with_values
from brushloop.twin.run import Estimate, fit_twin
from brushloop.twin.search import (
    Found,
    Repeats,
    Round,
    Target,
    agreement,
    choose_individual,
    derivatives,
    fit_spread,
    of_parts,
    off,
    search,
    start,
    statistics,
)

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))
CELLS = ((3.0, 0.0), (4.0, 5.0))
HERE = Offset(0.0, 0.0, 0.0)
BASE = BrushSpec(seed=0)


class Serial(Executor):
    """An executor that works in the process that asks."""

    def map(
        self, fn: Callable[..., Any], *iterables: Any, timeout: float | None = None, chunksize: int = 1
    ) -> Iterator[Any]:
        return map(fn, *iterables)


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
    before = start()
    after = search(target, before, Round(0.5, 2), Serial())
    squares = [float((off(target, 0, 0.5, one.point) ** 2).sum()) for one in (before, after)]
    assert squares[1] < 0.5 * squares[0]
    assert after.point[[one.name for one in SHAPE].index("film_mm")] > 0.2


def test_the_individual_nearest_to_the_captures_is_chosen(target: Target, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brushloop.twin.search.INDIVIDUALS", range(4))
    ink = draw(replace(BASE, seed=2), HERE, CELLS, GRID)
    assert choose_individual(replace(target, mean=ink[:, 0]), start(), Serial()).seed == 2


def test_what_the_parts_disagree_on_is_not_determined() -> None:
    points = [np.array([1.0, 0.0]), np.array([1.0, 3.0]), np.array([1.0, -3.0])]
    assert of_parts(points) == pytest.approx([0.0, 2.0 / 3.0 * 18.0])
    assert of_parts(points[:1]) == 0.0
    errors = np.sqrt(of_parts(points))
    assert [Estimate.of(SHAPE[k], 1.0, float(errors[k])).determined for k in (0, 1)] == [True, False]


def test_equal_repeats_agree_wholly_and_moved_ones_deviate_by_as_much_as_they_were_moved() -> None:
    one, moved = (draw(BrushSpec(), offset, CELLS, GRID)[:, 0] for offset in (HERE, Offset(0.0, 0.8, 0.0)))
    assert agreement([np.stack([a, a]) for a in one]) == pytest.approx(100.0)
    pairs = [np.stack([a, b]) for a, b in zip(one, moved, strict=True)]
    assert agreement(pairs) < 97.0
    assert np.exp(statistics(pairs, GRID)[1]) == pytest.approx(0.8 / np.sqrt(2.0), abs=0.15)


@pytest.mark.parametrize(("name", "value", "least"), [("place_wander_mm", 0.4, 0.25), ("reach_wander_mm", 1.0, 0.2)])
def test_presses_that_differ_more_give_a_wider_spread_of_that_kind(name: str, value: float, least: float) -> None:
    captured = draw(replace(BrushSpec(), **{name: value}), HERE, CELLS, GRID, repeats=6, first_seed=70)
    found = fit_spread(BrushSpec(), HERE, Repeats(CELLS, tuple(captured)), GRID)
    brush = with_values(BrushSpec(), SPREAD, found.point)
    assert least < getattr(brush, name) < 1.5 * value
    assert brush.strand_mm < 0.2
    assert found.twin_percent == pytest.approx(found.captured_percent, abs=6.0)  # small marks differ much


def test_the_shape_is_found_with_hairs_that_stray_as_those_of_the_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    strays: list[tuple[float, float]] = []

    def counted(target: Target, found: Found, one: Round, *_: object) -> Found:
        strays.append((one.blur_mm, target.base.strand_mm))
        return found  # how a search finds its way is tested above

    for name, value in {"COARSE": (Round(1.0, 1),), "FINE": Round(0.5, 1), "search": counted}.items():
        monkeypatch.setattr(f"brushloop.twin.run.{name}", value)
    monkeypatch.setattr("brushloop.twin.search.INDIVIDUALS", range(1))
    cell = (3.0, 0.0)
    brush = replace(BrushSpec(), strand_mm=0.5)
    captured = draw(brush, HERE, [cell], GRID, repeats=4)[0]
    twin = fit_twin([Pressed(*cell, ink) for ink in captured], GRID, brush.radius_mm, brush.length_mm, Serial())
    assert strays == [(1.0, BrushSpec().strand_mm), (0.5, pytest.approx(twin.spec.strand_mm, rel=0.2))]
    assert twin.spec.strand_mm > BrushSpec().strand_mm
