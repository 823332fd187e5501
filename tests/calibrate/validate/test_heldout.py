"""`fit` and `validate` leave out the same cells and print the same scores of one session."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.fit.brush import fit_session
from brushloop.calibrate.fit.captures import read_presses
from brushloop.calibrate.fit.heldout import BEZIER, FITTED
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate.command import Request, validate
from brushloop.calibrate.validate.models import BEZIER_REFITTED, FITTED_HELD_OUT

NAMES = {CEILING: CEILING, FITTED: FITTED_HELD_OUT, BEZIER: BEZIER_REFITTED}


def test_fit_and_validate_print_the_same_held_out_scores(session: Path, tmp_path: Path) -> None:
    captures = read_presses(session, Field())
    fitted = fit_session(captures, Field())
    fit = fitted.fit.save(tmp_path)
    report = validate(Request(places=(str(session),), fit=fit, out=tmp_path / "report", parquet=False)).report
    assert report is not None
    rows = {NAMES[row.model]: row for row in fitted.held_out if row.model in NAMES}
    assert set(rows) == set(NAMES.values())
    for name, row in rows.items():
        stat = report.stat(name)
        assert stat is not None
        assert (stat.csim.avg, stat.ssim.avg) == pytest.approx((row.csim, row.ssim), abs=0.005)
        assert stat.csim.n == row.n
        assert stat.csim.below_ceiling == (None if row.below is None else pytest.approx(row.below.avg, abs=0.005))
