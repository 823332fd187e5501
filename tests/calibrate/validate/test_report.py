"""`brushloop validate` from a session to its files: what is in them, what they say, and what cannot be edited away."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.compare.place import KEYS
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.presses import Press
from brushloop.calibrate.scores import Row, Scores
from brushloop.calibrate.stroke.measure import Measured
from brushloop.calibrate.validate.findings import trust
from brushloop.calibrate.validate.page import provenance
from brushloop.calibrate.validate.report import Collected, Report, load_report
from brushloop.calibrate.validate.tables import GateMissed, parse_gate
from brushloop.sessions.events import Remark
from brushloop.sessions.recording import Recording, add_remark
from brushloop.sessions.records import Header, Source, Stroke
from tests.browser import BROWSER, content_widths_px

MODELS = ("ccd-bsm", "bezier", "bezier-refitted", "ellipse", "line", "circle", "qbc", "another press")


def run(*arguments: str | Path) -> str:
    ran = CliRunner().invoke(app, ["validate", *map(str, arguments)])
    assert ran.exit_code == 0, ran.output
    return " ".join(ran.output.split())


@pytest.fixture(scope="module")
def folder(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report")
    said = run(session, "--out", out)
    assert "10 brush presses at 5 combinations" in said
    assert "1 more could not be used" in said
    assert "imported photographs" in said
    return out


@pytest.fixture(scope="module")
def report(folder: Path) -> Report:
    return load_report(folder / "report.json")


def test_every_model_is_scored_in_both_alignments_and_tones(report: Report) -> None:
    for model in MODELS:
        for key in KEYS:
            stat = report.stat(model, key)
            assert stat is not None
            for of in (stat.csim, stat.ssim):
                assert of.n == 10
                assert 0.0 < of.min <= of.median <= of.max <= 100.0
                assert of.avg_interval[0] <= of.avg <= of.avg_interval[1]
    cell = report.stat("ccd-bsm", cell=(15.0, 5.0))
    assert cell is not None
    assert cell.csim.n == 2


def test_a_refitted_bezier_has_not_seen_what_it_predicts_and_beats_the_published_one(report: Report) -> None:
    refitted, published = (report.stat(name) for name in ("bezier-refitted", "bezier"))
    assert refitted is not None
    assert published is not None
    assert refitted.csim.avg > published.csim.avg + 5.0
    rival = report.model("bezier-refitted")
    assert rival is not None
    assert rival.basis == "fitted, held-out cells"


def test_the_blank_capture_is_named_with_the_reason(report: Report, folder: Path) -> None:
    [refused] = report.refused
    assert refused.stroke_id == "blank"
    assert "is blank" in refused.why
    page = (folder / "report.html").read_text()
    assert "blank: is blank" in page
    with (folder / "failures.csv").open() as file:
        assert [row["stroke_id"] for row in csv.DictReader(file)] == ["blank"]


def test_tables_stand_beside_the_papers_numbers_and_carry_their_source(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    for number in ("91.84", "87.71", "67.03", "72.77", "98.21", "94.58"):
        assert number in page
    captions = re.findall(r"<caption>(.*?)</caption>", page, re.DOTALL)
    assert len(captions) >= 8
    assert all("imported photographs" in caption for caption in captions)
    for text in ("Table 1", "Table 2", "Table 3", "In short", "Can it be trusted?"):
        assert text in page


def test_the_page_is_one_file_that_fetches_nothing_and_escapes_what_others_wrote(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    sources = re.findall(r'src="([^"]*)"', page)
    assert sources
    assert all(re.match(r"data:image/(png|svg\+xml);base64,", source) for source in sources)
    links = re.findall(r'href="([^"]*)"', page)
    assert all(f'id="{link[1:]}"' in page or (folder / link).is_file() for link in links)
    assert {"scores.csv", "scores.parquet", "summary.csv", "report.json", "#cell-1"} <= set(links)
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert not re.search(r"url\(|@import|<link|<iframe", page)


def test_csv_and_parquet_hold_the_same_scores(folder: Path) -> None:
    with (folder / "scores.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = pyarrow.parquet.read_table(folder / "scores.parquet").to_pylist()
    assert len(rows) == len(table) > 10 * 4 * 7
    for text, binary in zip(rows, table, strict=True):
        assert float(text["csim"]) == pytest.approx(binary["csim"], abs=1e-7)
        assert {k: text[k] for k in ("stroke_id", "model", "source")} == {
            k: binary[k] for k in ("stroke_id", "model", "source")
        }


def test_every_score_of_a_twin_is_labelled_as_one() -> None:
    brush = "simulated bristle bundle (twin of monday, simulated), R = 5 mm"
    header = Header(session_id="s", source=Source.LOOPBACK, software="test", brush=brush)
    blank = np.zeros((128, 128), np.float32)
    stroke = Stroke(stroke_id="a", kind="press", still=0)
    press = Press(stroke, dict.fromkeys(KEYS, blank), blank, (0.0, 0.0), Measured(1, 1, 1, 1, 1), False, ())
    scores = Scores([Row.of(press, header)], ["ccd-bsm"])
    scores.values[:] = 0.9
    assert {score.source for score in scores} == {"loopback rig, brush twin of monday, simulated"}


def test_an_edited_report_is_not_read(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "copy")
    path = tmp_path / "copy" / "report.json"
    path.write_text(path.read_text().replace("imported photographs", "real capture"))
    with pytest.raises(CalibrationError, match="was edited"):
        load_report(path)


def test_a_gate_that_holds_passes_and_one_that_is_missed_exits_5(session: Path, folder: Path) -> None:
    run(session, "--out", folder, "--gate", "csim_avg>=0.10", "--gate", "circle:mm:gray:ssim_max<0.999")
    # Typer's runner keeps the exception; the front door gives it its exit code.
    arguments = ["validate", str(session), "--out", str(folder), "--gate", "circle:mm:csim_avg>=0.99"]
    ran = CliRunner().invoke(app, arguments)
    assert isinstance(ran.exception, GateMissed)
    assert ran.exception.exit_code == 5
    assert "csim_avg of circle, mm, binary is 0." in str(ran.exception)
    assert "imported photographs" in str(ran.exception)


@pytest.mark.parametrize(
    "text", ["csim>=0.9", "csim_mean>=0.9", "csim_avg>=90", "csim_avg>=x", "csim_avg=0.9", "a:b:csim_avg>=0.9", ""]
)
def test_what_is_no_gate_is_refused_before_any_work(text: str) -> None:
    with pytest.raises(CalibrationError, match=r"expected \[MODEL:\]\[ALIGNMENT:\]\[TONE:\]csim_avg>=0.90"):
        parse_gate(text)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("csim_avg>=0.90", ("", ("size-normalised", "binary"), "csim", "avg", ">=", 0.9)),
        ("mm:ssim_min > .5", ("", ("mm", "binary"), "ssim", "min", ">", 0.5)),
        ("bezier:csim_max<=1", ("bezier", ("size-normalised", "binary"), "csim", "max", "<=", 1.0)),
        ("another press:mm:gray:csim_median<1", ("another press", ("mm", "gray"), "csim", "median", "<", 1.0)),
    ],
)
def test_a_gate_names_model_images_and_statistic(text: str, parts: tuple[object, ...]) -> None:
    gate = parse_gate(text)
    assert (gate.model, gate.key, gate.measure, gate.statistic, gate.op, gate.limit) == parts


def test_only_the_models_asked_for_and_an_unknown_one_is_refused(session: Path, tmp_path: Path) -> None:
    run(session, "--out", tmp_path, "--model", "line", "--model", "circle", "--no-held-out")
    report = load_report(tmp_path / "report.json")
    assert {stat.model for stat in report.stats} == {"line", "circle", "another press", "ceiling"}
    ran = CliRunner().invoke(app, ["validate", str(session), "--out", str(tmp_path), "--model", "square"])
    assert isinstance(ran.exception, CalibrationError)
    assert "'square' is not one of: ccd-bsm" in str(ran.exception)


def test_a_capture_that_a_person_marked_bad_is_left_out_by_name(session: Path, tmp_path: Path) -> None:
    marked = tmp_path / session.name
    shutil.copytree(session, marked)
    still = next(stroke.still for stroke in Recording(marked).stroke_records() if stroke.stroke_id == "003")
    run(marked, "--out", tmp_path / "before", "--model", "line", "--no-held-out")
    add_remark(marked, Remark(t_ns=1, still=still, stroke_id="003", bad=True, note="<b>hair</b> in it"))
    for out in ("before", "after"):  # also where the work of before is still there
        run(marked, "--out", tmp_path / out, "--model", "line", "--no-held-out")
        reasons = {one.stroke_id: one.why for one in load_report(tmp_path / out / "report.json").refused}
        assert reasons["003"] == "was marked bad: <b>hair</b> in it"
        assert "&lt;b&gt;hair" in (tmp_path / out / "report.html").read_text()
    add_remark(marked, Remark(t_ns=2, still=still, stroke_id="003"))
    run(marked, "--out", tmp_path / "after", "--model", "line", "--no-held-out")
    assert "003" not in {one.stroke_id for one in load_report(tmp_path / "after" / "report.json").refused}


def test_ablations_show_lambda_and_the_number_of_strokes(session: Path, tmp_path: Path) -> None:
    curve = tmp_path / "training"
    curve.mkdir()
    (curve / "validation.csv").write_text("step,mse,iou,csim\n10,0.1,0.5,0.6\n20,0.01,0.9,0.95\n")
    given = ("--model", "ccd-bsm", "--model", "ccd-bsm-lambda-1", "--model", "ccd-bsm-lambda-pi/2")
    run(session, "--out", tmp_path / "out", *given, "--ablations", "--curves", f"QBC={curve}")
    report = load_report(tmp_path / "out" / "report.json")
    assert report.stat("ccd-bsm-lambda-1") is not None
    by_count = {step.strokes: step.csim for step in report.by_strokes if step.model == "CCD-BSM"}
    assert sorted(by_count) == [1, 2, 3, 5]
    assert by_count[5] > by_count[1]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "λ = π/2" in page
    assert "similarity against the number of fitted presses" in page
    assert "validation losses" in page


def test_what_was_left_out_selected_or_pressed_on_other_paper_stands_above_the_results(report: Report) -> None:
    def said(**changes: object) -> str:
        collected = Collected(
            planned=8, photographed=8, pressed_again=(), left_out=(), touches=("taught 1 mm",), moved_mm=0.0
        )
        session = report.sessions[0].model_copy(update={"collected": collected.model_copy(update=changes)})
        one = report.model_copy(update={"sessions": (session,)})
        return " ".join([*(point.text for point in trust(one)), *dict(provenance(session)).values()])

    assert "left out during" not in said()
    assert "8 planned, 8 photographed" in said()
    assert "2 of 8 planned strokes were left out during collection: a, b." in said(left_out=("a", "b"))
    assert "1 of 8 takes did not count and were pressed again" in said(pressed_again=("a",))
    touches = ("taught 1 mm", "jog 3 mm")
    assert "two zero touches differ by 2.00 mm (taught 1 mm, jog 3 mm)" in said(moved_mm=2.0, touches=touches)


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_fits_a_telephone_and_a_wide_screen_and_the_browser_has_nothing_to_say(
    folder: Path, tmp_path: Path
) -> None:
    sizes, errors = content_widths_px(
        {"report": (folder / "report.html").read_text()}, (390, 768, 1200, 1600), tmp_path
    )
    assert errors == []
    assert all(taken <= width for (_, width), taken in sizes.items()), sizes
