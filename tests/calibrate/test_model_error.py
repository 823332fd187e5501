"""Intervals of recovered presses hold the command although the model is wrong, or say that they may not."""

from dataclasses import replace

import numpy as np
import pytest

from brushloop.calibrate.invert import (
    NO_MODEL_ERROR,
    NOT_INFORMATIVE,
    Row,
    common_variance,
    covers_most,
    model_sd,
    with_model_error,
)
from brushloop.sessions.records import Condition

CELLS = [Condition(h, a) for h in (11.0, 13.0, 15.0, 17.0, 20.0) for a in (0.0, 5.0, 10.0)]


def rows(cells: list[Condition], error_mm: float, error_deg: float) -> list[Row]:
    rng = np.random.default_rng(0)
    return [
        Row(f"s{k}", h + error_mm * rng.normal(), a + error_deg * rng.normal(), 0.05, 0.2, 0.1, (), h, a)
        for k, (h, a) in enumerate((one.depth_mm, one.tilt_deg) for one in cells * 20)
    ]


def inside(made: list[Row]) -> float:
    return float(
        np.mean([abs(r.tilt_deg - (r.commanded_tilt_deg or 0.0)) <= 1.96 * (r.tilt_sd_deg or 0.0) for r in made])
    )


def test_a_model_error_is_in_the_interval() -> None:
    raw = rows(CELLS, 0.3, 2.0)
    assert inside(raw) < 0.3
    assert 0.93 <= inside(with_model_error(raw)) <= 0.99


def test_the_own_command_does_not_enter_the_interval() -> None:
    off = np.array([5.0, 0.1, 0.1, 0.1])
    found = model_sd(off, np.full(4, 0.01), [Condition(h, 0.0) for h in (11.0, 13.0, 15.0, 17.0)])
    assert found[0] == pytest.approx(0.1 * 3.182 / 1.96, rel=0.02)
    assert found[1] > 3.0


def test_a_cell_the_brush_was_not_fitted_to_takes_the_error_of_such_cells() -> None:
    cells = CELLS[:9]
    off = np.array([0.1] * 5 + [1.0] * 4)
    sd = np.full(9, 0.01)
    found = model_sd(off, sd, cells, fitted=cells[:5])
    assert found[5:] == pytest.approx(1.0 * 3.182 / 1.96, rel=0.01), "three other cells left out"
    assert (model_sd(off, sd, cells)[5:] < 1.0).all(), "diluted by the fitted cells"
    assert (model_sd(off[:6], sd[:6], cells[:6], fitted=cells[:5])[5:] < 0.2).all(), "none else left out: all cells"


def test_a_press_that_its_image_hardly_determines_counts_little() -> None:
    off, sd = np.array([0.5, -0.5, 0.5, 3.0]), np.array([0.01, 0.01, 0.01, 30.0])
    assert common_variance(off, sd) == pytest.approx(0.25 * 3 / 4, rel=0.1)
    assert common_variance(np.array([0.1, 0.1]), np.array([0.5, 0.5])) == 0.0


def test_too_few_known_cells_are_flagged() -> None:
    assert all(NO_MODEL_ERROR in row.flags for row in with_model_error(rows(CELLS[:3], 0.3, 2.0)))
    assert with_model_error([]) == []


def test_an_interval_over_most_of_the_commanded_range_is_flagged_and_still_given() -> None:
    vague, sharp = (with_model_error(rows(CELLS, 0.3, error_deg)) for error_deg in (4.0, 0.5))
    assert any(NOT_INFORMATIVE["alpha"] in row.flags and (row.tilt_sd_deg or 0.0) > 3.0 for row in vague)
    assert not any(set(row.flags) & set(NOT_INFORMATIVE.values()) for row in sharp)


@pytest.mark.parametrize(("value", "sd", "vague"), [(5.0, 2.5, True), (5.0, 1.5, False), (0.0, 2.5, False)])
def test_an_interval_is_cut_to_what_was_commanded(value: float, sd: float, vague: bool) -> None:
    assert covers_most(value, sd, [0.0, 5.0, 10.0]) is vague
    assert not covers_most(value, sd, [5.0, 5.0]), "one tilt only: there is no range to compare with"


def test_alpha_is_less_certain_where_the_brush_is_pressed_less() -> None:
    made = with_model_error(rows(CELLS, 0.3, 2.0))
    shallow, deep = ([r.tilt_sd_deg or 0.0 for r in made if r.commanded_depth_mm == h] for h in (11.0, 20.0))
    assert np.mean(shallow) == pytest.approx(np.mean(deep) * 20.0 / 11.0, rel=0.1)


def test_upright_presses_recovered_at_0_do_not_count_as_exact() -> None:
    half = [replace(r, tilt_deg=max(r.tilt_deg, 0.0)) for r in rows(CELLS[::3], 0.3, 2.0)]
    assert np.mean([r.tilt_deg == 0.0 for r in half]) > 0.4
    assert np.mean([r.tilt_sd_deg or 0.0 for r in with_model_error(half)]) > 1.9
