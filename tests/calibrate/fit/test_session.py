"""From photographs of presses to an artefact, a table and one more model in `validate`; loopback brush."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.artefact import FITS, current, load_artefact
from brushloop.calibrate.commands import FitRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.fit import BrushFit, fit_presses
from brushloop.calibrate.session import open_session
from brushloop.calibrate.validate.tables import load_report
from brushloop.model.fitted import NAME, NAMES
from tests.photographed import imported_presses

CELLS = [(11.0, 0.0), (11.0, 10.0), (15.0, 5.0), (20.0, 0.0), (20.0, 10.0)]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sessions") / "presses"
    return imported_presses(tmp_path_factory.mktemp("photos"), out, CELLS, (300, 480), (380, 150))


def test_a_session_is_fitted_written_and_shown_in_validate(session: Path) -> None:
    narrow = CliRunner(env={"COLUMNS": "60"})
    ran = narrow.invoke(app, ["fit", str(session)])
    assert ran.exit_code == 0, ran.output
    said = " ".join(ran.output.split())
    for words in ("heel", "width", "95 %", "left out of the fit in turn", "refitted Bezier", "uncalibrated"):
        assert words in said
    assert "…" not in said, "a size is cut in 60 columns"
    assert not any(name in said for name in NAMES), "a parameter alone says nothing about another brush"
    path = current(session, FITS)
    assert path is not None
    fit = load_artefact(path, BrushFit)
    assert fit.strokes == 5
    assert set(fit.cells) == set(CELLS)
    assert fit.csim_percent["fitted"] > fit.csim_percent["uncalibrated"] + 3.0
    ran = narrow.invoke(app, ["validate", str(session), "--model", "ccd-bsm", "--model", NAME])
    assert ran.exit_code == 0, ran.output
    assert "paper's" in ran.output
    assert "…" not in ran.output
    report = load_report(session / "validation" / "report.json")
    fitted = report.model(NAME)
    assert fitted is not None
    assert fitted.basis == "fitted, in sample"
    mean = {name: report.stat(name) for name in ("ccd-bsm", NAME)}
    assert mean[NAME].csim.avg > mean["ccd-bsm"].csim.avg + 5.0

    with pytest.raises(CalibrationError, match="holds presses: this needs drags"):
        open_session(session, kind="drag")


def test_one_command_leads_from_photographs_to_the_report(session: Path) -> None:
    ran = CliRunner(env={"COLUMNS": "120"}).invoke(app, ["analyse", str(session)])
    assert ran.exit_code == 0, ran.output
    assert "CCD-BSMG" in ran.output
    assert ran.output.splitlines()[-1] == f"Report: {session / 'validation' / 'report.html'}"
    assert load_report(session / "validation" / "report.json").model(NAME) is not None


def test_a_single_cell_gives_neither_intervals_nor_held_out_scores(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    pressed = imported_presses(tmp_path / "photos", tmp_path / "presses", CELLS[:1], (300, 480), (380, 150))
    fitted = fit_presses(FitRequest(pressed))
    assert fitted.held_out == []
    assert fitted.sizes == []
