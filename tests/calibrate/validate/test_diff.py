"""Two reports compared: equal ones differ in nothing, a better fit is found to be better."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.validate.diff import compare

MODELS = ("--model", "line", "--model", "ellipse", "--no-held-out")


def invoke(*arguments: str | Path) -> str:
    ran = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert ran.exit_code == 0, (ran.output, ran.exception)
    return ran.output


@pytest.fixture(scope="module")
def before(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("before")
    invoke("validate", session, "--out", out, *MODELS)
    return out


def test_a_report_does_not_differ_from_itself(before: Path) -> None:
    found = compare(before, before / "report.json")
    assert found.by_stroke
    assert len(found.changes) == 3 * 4 * 2
    assert {change.verdict for change in found.changes} == {"no significant difference"}
    assert all(change.test.mean == 0.0 and change.test.n == 10 for change in found.changes)


def test_another_scale_of_the_field_is_reported_stroke_by_stroke(session: Path, before: Path, tmp_path: Path) -> None:
    invoke("validate", session, "--out", tmp_path, *MODELS, "--mm-per-px", "0.5")
    found = {change.series: change for change in compare(before, tmp_path).changes}
    # A coarser field: more blank paper in every window of SSIM, in each of the five cells.
    coarser = found[("line", "mm", "binary", "ssim")]
    assert (coarser.test.n, coarser.test.groups) == (10, 5)
    assert coarser.test.interval is not None
    assert coarser.test.interval[0] > 0.0
    assert coarser.test.p == pytest.approx(2 / 2**5)  # signs are flipped by cell: five alike are no proof yet
    assert coarser.verdict == "no significant difference"
    table = invoke("validate", "diff", before, tmp_path)
    assert "the same stroke" in table
    assert "n = 10 in 5 cells" in table


def test_two_sessions_are_compared_cell_by_cell(make_session: object, before: Path, tmp_path: Path) -> None:
    other = make_session(tmp_path, "other", seed=500, blank=False)  # pyright: ignore[reportCallIssue]
    invoke("validate", other, *MODELS)
    found = compare(before, other)  # the session's own folder
    assert not found.by_stroke
    assert all(change.test.n == 5 for change in found.changes)
    assert {change.verdict for change in found.changes} == {"no significant difference"}


def test_what_has_no_report_or_an_edited_table_is_refused(session: Path, before: Path, tmp_path: Path) -> None:
    # A report of many sessions beside a session's folder is not that session's.
    shutil.copytree(session, tmp_path / "never", ignore=shutil.ignore_patterns("validation"))
    shutil.copytree(before, tmp_path / "validation")
    for never in (tmp_path / "never", tmp_path / "never" / "presses.mcap"):
        with pytest.raises(CalibrationError, match=f"{never}: was not validated: run `brushloop validate {never}`"):
            compare(before, never)
    with pytest.raises(CalibrationError, match=r"nowhere: does not exist: give a report\.json"):
        compare(tmp_path / "nowhere", before)
    edited = tmp_path / "validation" / "scores.csv"
    edited.write_text(edited.read_text().replace("0.9", "0.8"))
    with pytest.raises(CalibrationError, match="its SHA-256 differs"):
        compare(before, tmp_path / "validation")
