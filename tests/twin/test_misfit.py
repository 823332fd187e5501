"""The misfit of a twin: what it does to a mark, and that it is found in captures of another brush."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brushloop.drivers.sim.brush.brush import Brush
from brushloop.drivers.sim.brush.misfit import MODES, TERMS, Misfit, command_terms, profile
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.model import fitted
from brushloop.model.presses import Grid
from brushloop.twin.brush import HERE, draw
from brushloop.twin.misfit import fit_misfit

GRID = Grid(np.arange(-30.0, 12.0, 0.3), np.arange(12.0, -12.0, -0.3))
NOTHING = (0.0,) * TERMS
STRAIGHT = (NOTHING,) * MODES


def misfit(**changed: object) -> Misfit:
    fields = {"tip": NOTHING, "heel": NOTHING, "half": STRAIGHT, "middle": STRAIGHT} | changed
    return Misfit.model_validate({"depths_mm": (11.0, 20.0), "tilts_deg": (0.0, 10.0)} | fields)


def pressed(depth_mm: float, tilt_deg: float, bent: Misfit | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    measured = profile(Brush(BrushSpec(), bent).press(depth_mm, tilt_deg, ink_load=1.0, press_seed=1))
    assert measured is not None
    return measured


def test_a_mark_is_stretched_by_what_the_polynomials_say() -> None:
    longer = misfit(
        tip=(2.0, 0.5, 0.0, 0.0, 0.0, 0.0),
        heel=(-0.4, *NOTHING[1:]),
        half=((0.6, 0.0, 0.3, 0.0, 0.0, 0.0), *STRAIGHT[1:]),
        middle=((-0.5, *NOTHING[1:]), *STRAIGHT[1:]),
    )
    was, now = pressed(15.0, 10.0), pressed(15.0, 10.0, longer)
    ends, middle, half = (after - before for before, after in zip(was, now, strict=True))
    assert ends == pytest.approx([-2.0, -0.4], abs=0.15)
    amid = slice(28, 36)  # where the first sine is nearly 1
    assert (middle[amid].mean(), half[amid].mean()) == pytest.approx((-0.5, 0.9), abs=0.1)


def test_beyond_the_fitted_presses_the_misfit_is_that_of_the_nearest_and_fades_toward_the_touch() -> None:
    grows = misfit(tip=(1.0, 1.0, 0.0, 0.0, 0.0, 0.0))

    def further_mm(depth_mm: float) -> float:
        return float(pressed(depth_mm, 0.0)[0][0] - pressed(depth_mm, 0.0, grows)[0][0])

    at_20, at_11 = (1.0 + (depth_mm - 15.0) / 4.5 for depth_mm in (20.0, 11.0))
    assert further_mm(22.0) == pytest.approx(at_20, abs=0.2)
    assert further_mm(5.5) == pytest.approx(0.5 * at_11, abs=0.2)
    blank = Brush(BrushSpec(), grows).press(15.0, 0.0, ink_load=0.0, press_seed=1)
    assert not blank.density.any()


def test_the_marks_of_another_brush_are_imitated_in_a_press_that_was_not_captured() -> None:
    other = replace(BrushSpec(), film_mm=0.8, taper_power=1.3, bow_mm=0.0)
    cells = [(depth_mm, tilt_deg) for depth_mm in (11.0, 15.0, 20.0) for tilt_deg in (0.0, 10.0)]
    captured = dict(zip(cells, draw(other, HERE, cells, GRID, 3, first_seed=50), strict=True))
    found = fit_misfit(BrushSpec(), HERE, captured, GRID)
    assert found is not None
    held = [(17.0, 5.0)]
    wanted = draw(other, HERE, held, GRID, 3, first_seed=90).mean(axis=(0, 1))
    plain, bent = (draw(BrushSpec(), HERE, held, GRID, misfit=one).mean(axis=(0, 1)) for one in (None, found))
    assert np.abs(bent - wanted).sum() < 0.4 * np.abs(plain - wanted).sum()


def test_polynomials_have_the_terms_of_the_fitted_stroke_model() -> None:
    terms = fitted.command_terms(np.float64(17.0), np.float64(3.0))
    assert command_terms(17.0, 3.0).tolist() == terms.tolist()
