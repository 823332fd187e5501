import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from calibrate.compare.ceiling import CEILING
from calibrate.fit.captures import Grid, Pressed
from calibrate.fit.fit import STAGES, condition_number, draw, fit_presses, refit, zero_touch
from calibrate.fit.heldout import FITTED, leave_cell_out
from calibrate.fit.prior import learned
from model.fitted import NAMES, PARAMETERS, FittedPress, published

PX_MM = 0.4
GRID = Grid((np.arange(100) + 0.5) * PX_MM - 31.0, 8.0 - (np.arange(40) + 0.5) * PX_MM)
CELLS = [(11.0, 0.0), (11.0, 10.0), (15.0, 5.0), (20.0, 0.0), (20.0, 10.0)]


def a_brush(**changed: float) -> FittedPress:
    values = published()
    known = {"lam": 1.7, "heel_gain": 4.0, "tip_gain": 0.8, "origin_gain": -0.4, "core_mm": 0.4, "tip_power": 1.6}
    for name, value in (known | changed).items():
        values[NAMES.index(name)] = value
    return FittedPress(6.0, 48.0, values)


def presses(brush: FittedPress, cells: list[tuple[float, float]], noise: float = 0.0, seed: int = 0) -> list[Pressed]:
    rng = np.random.default_rng(seed)
    out = []
    for height, tilt in cells:
        y = GRID.y_mm + noise * rng.normal()
        out.append(Pressed(height, tilt, brush.chance(height, tilt, GRID.x_mm + noise * rng.normal(), y, 0.15)))
    return out


def value(press: FittedPress, name: str) -> float:
    return float(press.values[NAMES.index(name)])


def test_a_brush_of_the_family_is_found_again() -> None:
    truth = a_brush(h0_mm=1.0, width_power=1.2)
    fit = fit_presses(presses(truth, CELLS), GRID, 6.0, 48.0, residual=False)
    for height, tilt in [(13.0, 5.0), (17.0, 10.0)]:
        seen, wanted = (np.maximum(b.half_width(height, tilt, GRID.x_mm), 0.0) for b in (fit.press, truth))
        assert seen.max() == pytest.approx(wanted.max(), rel=0.03)
        assert np.abs(seen - wanted).mean() < 0.05


def known(strokes: list[Pressed], name: str) -> tuple[float, float]:
    """Standard deviation of a parameter, and the share of its variance that the strokes removed."""
    fit = fit_presses(strokes, GRID, 6.0, 48.0, residual=False)
    at = fit.free.index(name)
    return float(fit.errors[at]), float(fit.from_strokes[at])


def test_what_the_strokes_do_not_tell_keeps_the_deviation_of_known_brushes() -> None:
    one_cell = presses(a_brush(), [(15.0, 0.0)] * 3, noise=0.05)
    prior_sd = float(np.linalg.inv(learned().precision)[NAMES.index("width_tilt"), NAMES.index("width_tilt")] ** 0.5)
    sd, share = known(one_cell, "width_tilt")
    assert sd == pytest.approx(0.02 * prior_sd, rel=0.3)
    assert share < 0.5
    assert known(presses(a_brush(), CELLS, noise=0.05), "width_tilt")[1] > 0.6


def test_an_interval_does_not_jump_as_a_condition_number_grows() -> None:
    sds = []
    for apart_mm in (0.0, 0.25, 0.5, 1.0, 2.0, 4.0):
        cells = [(15.0, 0.0), (15.0 + apart_mm, 0.0), (15.0, 5.0)]
        sds.append(known(presses(a_brush(), cells, noise=0.0), "h0_mm")[0])
    assert all(0.5 < b / a < 1.1 for a, b in pairwise(sds)), sds


def test_the_condition_number_is_that_of_unit_columns() -> None:
    jacobian = np.array([[1.0, 100.0], [0.0, 1.0]])
    scaled = jacobian / np.linalg.norm(jacobian, axis=0)
    assert condition_number(jacobian.T @ jacobian) == pytest.approx(np.linalg.cond(scaled), rel=1e-6)
    assert condition_number(np.diag([1.0, 0.0])) == math.inf


def test_a_zero_touch_that_moved_is_distinguished_from_an_earlier_fit() -> None:
    brush = a_brush()
    moved = replace(brush, values=brush.values.copy())
    moved.values[NAMES.index("h0_mm")] = 0.6
    now, error = zero_touch(brush, presses(moved, CELLS[:3], noise=0.05), GRID)
    assert value(now, "h0_mm") == pytest.approx(0.6, abs=0.1)
    assert error[0] < 0.2


def test_intervals_narrow_with_strokes() -> None:
    def width(repeats: int) -> float:
        strokes = presses(a_brush(), CELLS * repeats, noise=0.15)
        fit = fit_presses(strokes, GRID, 6.0, 48.0, residual=False, stages=STAGES[:2])
        return float(fit.errors[fit.free.index("origin_mm")])

    assert width(6) < 0.8 * width(1)


def test_products_of_the_jacobian_are_those_of_the_whole_image() -> None:
    edges = np.zeros_like(a_brush().edges)
    edges[:, :2, 0] = [[0.5, -0.2], [0.1, 0.3]]  # the two edges differ
    brush = replace(a_brush(), edges=edges)
    drawn = draw(brush, NAMES, 15.0, 5.0, GRID)
    columns = []
    for k, parameter in enumerate(PARAMETERS):
        step = np.zeros(len(NAMES))
        step[k] = 1e-6 * parameter.spread
        ahead, behind = (replace(brush, values=brush.values + way * step) for way in (1, -1))
        images = [one.chance(15.0, 5.0, GRID.x_mm, GRID.y_mm, 0.15) for one in (ahead, behind)]
        columns.append((images[0] - images[1]).ravel() / 2e-6)
    jacobian, residual = np.array(columns), np.random.default_rng(0).normal(size=drawn.ink.shape)
    assert drawn.ink == pytest.approx(brush.chance(15.0, 5.0, GRID.x_mm, GRID.y_mm, 0.15))
    assert drawn.square() == pytest.approx(jacobian @ jacobian.T, rel=1e-2, abs=1e-2)
    assert drawn.pull(residual) == pytest.approx(jacobian @ residual.ravel(), rel=2e-2, abs=2e-2)


def test_edges_that_the_profile_does_not_have_are_found() -> None:
    truth = replace(a_brush(), edges=np.zeros_like(a_brush().edges))
    truth.edges[0, 1, 0] = 0.5
    fit = fit_presses(presses(truth, CELLS), GRID, 6.0, 48.0)
    assert fit.press.edges[0, 1, 0] - fit.press.edges[1, 1, 0] == pytest.approx(0.5, abs=0.15)


def test_held_out_cells_are_scored_beside_the_ceiling() -> None:
    strokes = presses(a_brush(), CELLS * 3, noise=0.05)
    rows = {row.model: row for row in leave_cell_out(strokes, GRID, 6.0, 48.0)}
    assert rows[FITTED].n == rows[CEILING].n == 15
    assert rows["uncalibrated"].csim + 5.0 < rows[FITTED].csim <= 100.0
    below = rows[FITTED].below
    assert below is not None
    assert below.mean == pytest.approx(rows[CEILING].csim - rows[FITTED].csim)
    assert below.mean < 2.5
    assert below.interval is not None
    assert below.interval[0] < below.mean < below.interval[1]
    assert rows[CEILING].below is None


def test_two_presses_of_a_cell_are_enough_for_the_ceiling_and_one_is_not() -> None:
    for repeats, known in ((2, True), (1, False)):
        strokes = presses(a_brush(), CELLS[:3] * repeats, noise=0.05)
        rows = {row.model: row for row in leave_cell_out(strokes, GRID, 6.0, 48.0)}
        assert (CEILING in rows) is known
        assert (rows[FITTED].below is not None) is known
    assert leave_cell_out(presses(a_brush(), CELLS[:1] * 2), GRID, 6.0, 48.0) == []


def test_a_fit_needs_a_stroke() -> None:
    with pytest.raises(ValueError, match="at least one stroke"):
        fit_presses([], GRID, 6.0, 48.0)
    with pytest.raises(ValueError, match="at least one stroke"):
        refit(a_brush(), [], GRID)
