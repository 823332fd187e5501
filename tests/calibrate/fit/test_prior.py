"""The prior of the fit and the residual: what is known before the first stroke, and what parameters cannot express."""

from dataclasses import replace

import numpy as np
import pytest

from brushloop.calibrate.fit.fit import regress
from brushloop.calibrate.fit.prior import KnownBrush, about, learned, of_brushes
from brushloop.model.fitted import NAMES, TERMS, FittedPress, command_terms, published

CELLS = [(h, a) for h in (11.0, 15.0, 20.0) for a in (0.0, 5.0, 10.0)]


def test_the_prior_lies_among_the_known_brushes_and_admits_others() -> None:
    prior = learned()
    lam = NAMES.index("lam")
    assert 1.0 < prior.values[lam] < 2.5, "far from the published pi"
    deviation = np.sqrt(np.diag(np.linalg.inv(prior.precision)))
    assert np.all(deviation >= 0.15)
    assert np.all(about(published()).values == published())


def test_a_family_can_be_left_out_and_none_is_of_the_loopback_rig() -> None:
    assert not np.allclose(learned(("leaf",)).mean, learned().mean)
    for unknown in ("no such family", "loopback rig"):
        assert np.array_equal(learned((unknown,)).mean, learned().mean)


def test_a_large_family_does_not_outweigh_a_small_one() -> None:
    def brush(family: str, lam: float) -> KnownBrush:
        values = published()
        values[0] = lam
        return KnownBrush(name=f"{family} {lam}", family=family, values=tuple(values))

    prior = of_brushes([*[brush("large", 1.0)] * 16, brush("small", 2.0)])
    assert prior.values[0] == pytest.approx(1.2)
    with pytest.raises(ValueError, match="at least two"):
        of_brushes([brush("only", 1.0)])


def test_strokes_that_repeat_are_followed_and_strokes_that_do_not_are_smoothed() -> None:
    terms = np.array([command_terms(*cell) for cell in CELLS])
    alternating = 0.5 * (-1.0) ** np.arange(len(CELLS))
    steady = regress(np.full((len(CELLS), 1), 0.5), terms, np.ones(1))
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
    end = after.widest + after.heel - 0.1
    assert brush.half_width(15.0, 5.0, end) < 0.0 < moved.half_width(15.0, 5.0, end)
