"""The fit of a brush: parameters, residuals, held-out conditions; and from the photographs of a session to its fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.artefact import FITS, current
from brushloop.calibrate.commands import FitRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.command import FEWEST_CONDITIONS, BrushFit, fit_press_session, sizes_of
from brushloop.calibrate.fit.fit import SPREAD_MM, draw, fit_presses, regress
from brushloop.calibrate.fit.heldout import BEZIER, FITTED, UNCALIBRATED, leave_condition_out
from brushloop.calibrate.session import open_session
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate.tables import Report
from brushloop.model.fitted import (
    NAME,
    NAMES,
    PARAMETERS,
    TERMS,
    FittedPress,
    Prior,
    command_terms,
    learned,
    published,
    spreads,
)
from brushloop.model.presses import Grid, Presses, image_of
from tests.calibrate.conftest import CONDITIONS
from tests.command import said
from tests.photographed import imported_presses

PX_MM = 0.4
GRID = Grid((np.arange(100) + 0.5) * PX_MM - 31.0, 8.0 - (np.arange(40) + 0.5) * PX_MM)


def a_brush(**changed: float) -> FittedPress:
    values = published()
    known = {"lam": 1.7, "heel_gain": 4.0, "tip_gain": 0.8, "origin_gain": -0.4, "core_mm": 0.4, "tip_power": 1.6}
    for name, value in (known | changed).items():
        values[NAMES.index(name)] = value
    return FittedPress(6.0, 48.0, values)


def presses(brush: FittedPress, conditions: list[tuple[float, float]], noise: float = 0.0, seed: int = 0) -> Presses:
    rng = np.random.default_rng(seed)
    ink = []
    for condition in conditions:
        y = GRID.y_mm + noise * rng.normal()
        ink.append(brush.chance(*condition, GRID.x_mm + noise * rng.normal(), y, SPREAD_MM))
    return Presses(6.0, 48.0, GRID, np.array(conditions).reshape(-1, 2), np.array(ink))


def test_a_brush_of_the_family_is_found_again() -> None:
    truth = a_brush(h0_mm=1.0, width_power=1.2)
    fit = fit_presses(presses(truth, CONDITIONS), residual=False)
    for height, tilt in [(13.0, 5.0), (17.0, 10.0)]:
        seen, wanted = (np.maximum(b.mark(height, tilt, GRID.x_mm)[0], 0.0) for b in (fit, truth))
        assert seen.max() == pytest.approx(wanted.max(), rel=0.03)
        assert np.abs(seen - wanted).mean() < 0.05


@pytest.mark.parametrize("seed", [221, 63])
def test_a_brush_far_from_all_known_ones_does_not_end_the_fit_far_from_its_marks(seed: int) -> None:
    """One ended .31 mm from the left-out condition from the prior alone, the other .39 mm with size and place first."""
    conditions = [(h, a) for h in (11.0, 13.0, 15.0, 17.0, 20.0) for a in (0.0, 5.0, 10.0)]
    known, rng = learned(), np.random.default_rng(seed)
    far = spreads() * np.linalg.cholesky(np.linalg.inv(known.precision)) @ rng.normal(size=len(NAMES))
    low, high = (np.array([getattr(spec, end) for spec in PARAMETERS]) for end in ("low", "high"))
    truth = FittedPress(6.0, 48.0, np.clip(known.values + 1.5 * far, low, high))
    fit = fit_presses(presses(truth, conditions[:-1], noise=0.2, seed=seed), residual=False)
    seen, wanted = (np.maximum(b.mark(*conditions[-1], GRID.x_mm)[0], 0.0) for b in (fit, truth))
    assert np.abs(seen - wanted).mean() < 0.2


def test_sizes_of_marks_are_those_of_the_brush_with_intervals_that_narrow() -> None:
    truth = a_brush()
    at = truth.sizes(15.5, 5.0)
    few = sizes_of(presses(truth, CONDITIONS, noise=0.2))
    assert [*few] == ["reach toward the tip", "reach toward the heel", "width"]
    here, by_depth, _ = few["width"]
    assert here.low < 2.0 * (at.half + 0.4) < here.high
    assert by_depth.low > 0.0, "it opens as it is pressed deeper"
    every = [(height, tilt) for height in (11.0, 13.0, 15.0, 17.0, 20.0) for tilt in (0.0, 5.0, 10.0)]
    more, *_ = sizes_of(presses(truth, every, noise=0.2))["width"]
    assert more.high - more.low < 0.7 * (here.high - here.low)


def test_too_few_conditions_give_no_interval_and_one_no_held_out_scores(tmp_path: Path) -> None:
    assert sizes_of(presses(a_brush(), CONDITIONS[: FEWEST_CONDITIONS - 1] * 3)) == {}
    assert sizes_of(presses(a_brush(), [(h, 0.0) for h in range(11, 18)])) == {}, "one tilt shows no slope"
    fitted = fit_press_session(FitRequest(imported_presses(tmp_path, CONDITIONS[:1])))
    assert (fitted.held_out, fitted.sizes) == ([], {})


def test_products_of_the_jacobian_are_those_of_the_whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brushloop.calibrate.fit.fit.STEP", 1e-5)  # so short that both derivatives agree
    brush = a_brush()
    [_, drawn] = draw(brush, np.array([(11.0, 0.0), (15.0, 5.0)]), GRID)
    columns = []
    for k, parameter in enumerate(PARAMETERS):
        step = np.zeros(len(NAMES))
        step[k] = 1e-6 * parameter.spread
        ahead, behind = (replace(brush, values=brush.values + way * step) for way in (1, -1))
        images = [one.chance(15.0, 5.0, GRID.x_mm, GRID.y_mm, SPREAD_MM) for one in (ahead, behind)]
        columns.append((images[0] - images[1]).ravel() / 2e-6)
    jacobian, residual = np.array(columns), np.random.default_rng(0).normal(size=drawn.ink.shape)
    assert drawn.ink == pytest.approx(brush.chance(15.0, 5.0, GRID.x_mm, GRID.y_mm, SPREAD_MM))
    assert drawn.square() == pytest.approx(jacobian @ jacobian.T, rel=2e-2, abs=2e-2)
    assert drawn.pull(residual[None])[0] == pytest.approx(jacobian @ residual.ravel(), rel=2e-2, abs=2e-2)


def test_a_tip_beside_the_axis_and_a_width_that_the_profile_does_not_have_are_found() -> None:
    truth = replace(a_brush(), across=np.zeros_like(a_brush().across))
    truth.across[:, 1, 0] = 0.4, -0.5  # wider and lower at the tip
    strokes = presses(truth, CONDITIONS)
    fit = fit_presses(strokes)
    near_tip = truth.sizes(15.0, 5.0).widest - 0.8 * truth.sizes(15.0, 5.0).tip
    (_, seen), (_, wanted) = (brush.mark(15.0, 5.0, np.array([near_tip])) for brush in (fit, truth))
    assert seen == pytest.approx(wanted, abs=0.1)
    assert wanted < -0.3
    images = [image_of(brush.outline(15.0, 5.0), GRID) for brush in (fit, fit_presses(strokes, residual=False), truth)]
    fitted, alone = (np.abs(image - images[-1]).sum() for image in images[:2])
    assert fitted < 0.3 * alone


def test_a_blunt_end_is_blunt_at_every_depth_so_that_images_change_smoothly() -> None:
    brush = replace(a_brush(core_mm=0.0), across=np.zeros_like(a_brush().across))
    brush.across[0, 0, 0] = 0.3
    depths = np.linspace(11.0, 20.0, 200)
    outlines = brush.outline(depths, np.full(200, 5.0)).points
    assert outlines[:, 0, 0, 1] == pytest.approx(-0.3)


def test_held_out_conditions_are_scored_beside_the_ceiling_which_one_press_of_each_does_not_show() -> None:
    strokes = presses(a_brush(), CONDITIONS * 2, noise=0.05)
    rows = {row.model: row for row in leave_condition_out(strokes, fit_presses(strokes))[0]}
    fitted, ceiling = rows[FITTED].csim, rows[CEILING].csim
    assert fitted.n == ceiling.n == 10
    assert rows[UNCALIBRATED].csim.avg + 5.0 < fitted.avg <= 100.0
    assert fitted.below_ceiling == pytest.approx(ceiling.avg - fitted.avg, abs=1e-5)
    assert fitted.below_interval is not None
    assert fitted.below_interval[0] < fitted.below_ceiling < min(2.5, fitted.below_interval[1])
    assert ceiling.below_ceiling is None

    once = presses(a_brush(), CONDITIONS[:3], noise=0.05)
    alone = {row.model: row for row in leave_condition_out(once, fit_presses(once))[0]}
    assert CEILING not in alone
    assert alone[FITTED].csim.below_ceiling is None
    assert leave_condition_out(presses(a_brush(), CONDITIONS[:1] * 2), a_brush()) == ([], {})
    with pytest.raises(ValueError, match="at least one press"):
        fit_presses(presses(a_brush(), []))


def test_the_prior_lies_among_the_known_brushes_and_admits_others() -> None:
    prior = learned()
    lam = NAMES.index("lam")
    assert 1.0 < prior.values[lam] < 2.5, "far from the published pi"
    deviation = np.sqrt(np.diag(np.linalg.inv(prior.precision)))
    assert np.all(deviation >= 0.15)


def test_a_large_family_does_not_outweigh_a_small_one() -> None:
    def brush(lam: float) -> np.ndarray:
        values = published()
        values[0] = lam
        return values

    assert Prior.of_brushes([*[("large", brush(1.0))] * 16, ("small", brush(2.0))]).values[0] == pytest.approx(1.2)


def test_strokes_that_repeat_are_followed_and_strokes_that_do_not_are_smoothed() -> None:
    conditions = np.array([(h, a) for h in (11.0, 15.0, 20.0) for a in (0.0, 5.0, 10.0)])
    terms = command_terms(*conditions.T)
    alternating = 0.5 * (-1.0) ** np.arange(len(conditions))
    steady = regress(np.full((len(conditions), 1), 0.5), terms, np.ones(1))
    erratic = regress(alternating[:, None], terms, np.ones(1))
    assert terms @ steady[0] == pytest.approx(0.5, abs=0.05)
    assert np.abs(terms @ erratic[0]).max() < 0.15


def test_the_ends_of_a_brush_move_by_its_residual() -> None:
    brush = FittedPress(6.0, 48.0)
    ends = np.zeros((2, TERMS))
    ends[:, 0] = (1.0, 0.5)
    moved = replace(brush, ends=ends)
    before, after = brush.sizes(15.0, 5.0), moved.sizes(15.0, 5.0)
    assert (after.tip - before.tip, after.heel - before.heel) == (pytest.approx(1.0), pytest.approx(0.5))
    end = np.array([after.widest + after.heel - 0.1])
    assert brush.mark(15.0, 5.0, end)[0].max() < 0.0 < moved.mark(15.0, 5.0, end)[0].max()


def test_one_command_leads_from_photographs_to_a_fit_and_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    session = imported_presses(tmp_path, CONDITIONS)
    output = said("analyse", session)
    sizes = "heel", "width", "95 %", "left out of the fit", BEZIER, UNCALIBRATED
    for words in (*sizes, "paper's", "CCD-BSMG"):
        assert words in output
    assert "…" not in output, "a size is cut in 60 columns"
    assert not any(name in output for name in NAMES), "a parameter alone says nothing about another brush"
    assert output.replace(" ", "").endswith(f"Report:{session / 'validation' / 'report.html'}")
    path = current(session, FITS)
    assert path is not None
    fit = BrushFit.read(path)
    assert (fit.strokes, set(fit.cells)) == (5, set(CONDITIONS))
    assert fit.csim_percent[FITTED] > fit.csim_percent[UNCALIBRATED] + 3.0
    report = Report.read(session / "validation" / "report.json")
    fitted = report.model(NAME)
    assert fitted is not None
    assert fitted.basis == "fitted, in sample"
    mean = {name: report.stat(name) for name in ("ccd-bsm", NAME)}
    assert mean[NAME].csim.avg > mean["ccd-bsm"].csim.avg + 5.0

    with pytest.raises(CalibrationError, match="holds presses, but drags are needed here"):
        open_session(session, kind="drag")
