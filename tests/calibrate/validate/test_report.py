"""`brushloop validate` from a session to its files, and two reports compared: what they say, and what is refused."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet
import pytest

import brushloop
from brushloop.calibrate.commands import DiffRequest, FitRequest, ValidateRequest
from brushloop.calibrate.compare import KEYS, images_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.command import fit_press_session
from brushloop.calibrate.fit.heldout import BEZIER, FITTED
from brushloop.calibrate.report import templates
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.validate import run as validation
from brushloop.calibrate.validate.command import compare, validate
from brushloop.calibrate.validate.page import headline, trust
from brushloop.calibrate.validate.run import BEZIER_REFITTED, FITTED_HELD_OUT
from brushloop.calibrate.validate.tables import Collected, GateMissed, Report, check_gates, collected_in
from brushloop.sessions.events import CaptureResult, Condition, DipResult, Remark, ZeroTouchResult
from brushloop.sessions.events import Press as Pressed
from brushloop.sessions.recording import Recording, add_remark
from brushloop.sessions.records import Header, Source, Stroke
from brushloop.sessions.store import SessionStore
from tests.calibrate.conftest import CONDITIONS
from tests.calibrate.given import rows_of
from tests.command import brushloop as brushloop_process
from tests.command import refused, said
from tests.photographed import imported_presses

MODELS = ("ccd-bsm", "bezier", "bezier-refitted", "ellipse", "line", "circle", "qbc", "another press")
QUICK = ("--model", "line", "--no-held-out")


@pytest.fixture(scope="module")
def folder(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report")
    output = said("validate", session, "--out", out, left_out=True)
    assert "10 brush presses at 5 combinations" in output
    assert "1 more could not be used" in output
    assert "imported photographs" in output
    return out


@pytest.fixture(scope="module")
def report(folder: Path) -> Report:
    return Report.read(folder)


def test_every_model_is_scored_in_both_alignments_and_tones(report: Report) -> None:
    for model, key in itertools.product(MODELS, KEYS):
        stat = report.stat(model, key)
        assert stat is not None
        for of in (stat.csim, stat.ssim):
            assert of.n == 10
            assert 0.0 < of.min <= of.median <= of.max <= 100.0
            assert of.avg_interval[0] <= of.avg <= of.avg_interval[1]
    condition, ceiling = report.stat("ccd-bsm", condition=(15.0, 5.0)), report.stat(CEILING)
    assert (condition.csim.n, ceiling.csim.max) == (2, None)
    # It has not seen what it predicts, and yet knows this brush.
    refitted, published = (report.stat(name) for name in (BEZIER_REFITTED, "bezier"))
    assert refitted.csim.avg > published.csim.avg + 5.0


def test_fit_and_validate_print_the_same_held_out_scores(session: Path, tmp_path: Path) -> None:
    copied = Path(shutil.copytree(session, tmp_path / session.name))
    fitted = fit_press_session(FitRequest(copied))
    report = validate(ValidateRequest(places=(copied,), fit=fitted.path, out=tmp_path / "report")).report
    assert report is not None
    rows = {row.model: row for row in fitted.held_out}
    for name, validated in {CEILING: CEILING, FITTED: FITTED_HELD_OUT, BEZIER: BEZIER_REFITTED}.items():
        stat, row = report.stat(validated), rows[name]
        assert stat is not None
        for validated_by, fitted_by in ((stat.csim, row.csim), (stat.ssim, row.ssim)):
            assert validated_by.n == fitted_by.n
            assert validated_by.avg == pytest.approx(fitted_by.avg, abs=0.005)
            assert (validated_by.below_ceiling or 0.0) == pytest.approx(fitted_by.below_ceiling or 0.0, abs=0.005)


def test_the_page_has_the_papers_numbers_its_source_and_what_was_refused(report: Report, folder: Path) -> None:
    page = (folder / "report.html").read_text()
    for text in ("91.84", "87.71", "67.03", "72.77", "98.21", "94.58", "Table 1", "Table 2", "Table 3"):
        assert text in page
    captions = re.findall(r"<caption>(.*?)</caption>", page, re.DOTALL)
    assert len(captions) >= 7
    assert all("imported photographs" in caption for caption in captions)
    assert [(press.stroke_id, press.why.partition(":")[0]) for press in report.refused] == [("blank", "is blank")]
    assert "blank: is blank" in page
    assert 'blank,"is blank' in (folder / "failures.csv").read_text()
    links = re.findall(r'href="([^"]*)"', page)
    assert all(f'id="{link[1:]}"' in page or (folder / link).is_file() for link in links)
    assert {"scores.csv", "scores.parquet", "summary.csv", "report.json", "#condition-1"} <= set(links)
    assert "&lt;script&gt;" in page
    assert not re.search(r"<script|url\(|@import|<link|<iframe", page)


def test_csv_and_parquet_hold_the_same_scores(folder: Path) -> None:
    rows = rows_of(folder / "scores.csv")
    table = pyarrow.parquet.read_table(folder / "scores.parquet").to_pylist()
    assert len(rows) == len(table) > 10 * 4 * 7
    for text, binary in zip(rows, table, strict=True):
        assert float(text["csim"]) == pytest.approx(binary["csim"], abs=1e-7)
        assert all(text[name] == binary[name] for name in ("stroke_id", "model", "alignment", "source"))


def test_a_gate_that_holds_passes_and_one_that_is_missed_says_by_how_much_and_exits_5(report: Report) -> None:
    check_gates(report, ["csim_avg>=0.10", "another press:mm:gray:csim_median >= .9", "ssim_min>=0"])
    with pytest.raises(GateMissed, match=r"csim_avg of circle, mm, binary is 0\..* \(imported photographs\)") as missed:
        check_gates(report, ["circle:mm:csim_avg>=0.99"])
    assert missed.value.exit_code == 5
    with pytest.raises(CalibrationError, match="'ceiling' has no max; models with scores: ccd-bsm"):
        check_gates(report, ["ceiling:csim_max>=0.9"])


@pytest.mark.parametrize(
    "text", ["csim>=0.9", "csim_mean>=0.9", "csim_avg>=90", "csim_avg=0.9", "a:b:csim_avg>=0.9", ""]
)
def test_what_is_no_gate_is_refused_before_any_work(text: str) -> None:
    with pytest.raises(CalibrationError, match="must be like csim_avg"):
        validate(ValidateRequest(places=(Path("nowhere"),), gates=(text,)))


def test_only_the_models_asked_for_and_an_unknown_one_is_refused(session: Path, tmp_path: Path) -> None:
    said("validate", session, "--out", tmp_path, *QUICK, "--model", "circle", left_out=True)
    report = Report.read(tmp_path)
    assert {stat.model for stat in report.stats} == {"line", "circle", "another press", "ceiling"}
    assert "'square' is not one of: ccd-bsm" in refused("validate", session, "--out", tmp_path, "--model", "square")


def test_a_capture_that_a_person_marked_bad_is_left_out_by_name(session: Path, tmp_path: Path) -> None:
    marked = tmp_path / session.name
    shutil.copytree(session, marked)
    still = next(stroke.still for stroke in Recording(marked).stroke_records() if stroke.stroke_id == "3")
    for bad in (True, False):  # also where the work of before is still there
        add_remark(marked, Remark(t_ns=1, still=still, stroke_id="3", bad=bad, note="<b>hair</b> in it"))
        said("validate", marked, "--out", tmp_path / "out", *QUICK, left_out=True)
        reasons = {press.stroke_id: press.why for press in Report.read(tmp_path / "out").refused}
        assert reasons.get("3") == ("was marked bad: <b>hair</b> in it" if bad else None)
        assert ("&lt;b&gt;hair" in (tmp_path / "out" / "report.html").read_text()) == bad


def test_ablations_show_lambda_and_the_number_of_strokes(session: Path, tmp_path: Path) -> None:
    curve = tmp_path / "training"
    curve.mkdir()
    (curve / "validation.csv").write_text("step,mse,iou,csim\n10,0.1,0.5,0.6\n20,0.01,0.9,0.95\n")
    given = ("--ablations", "--model", "ccd-bsm", "--model", "ccd-bsm-lambda-1", "--model", "ccd-bsm-lambda-pi/2")
    said("validate", session, "--out", tmp_path / "out", *given, "--curves", f"QBC={curve}", left_out=True)
    report = Report.read(tmp_path / "out")
    assert report.stat("ccd-bsm-lambda-1") is not None
    by_count = {step.strokes: step.csim for step in report.by_strokes if step.model == "CCD-BSM"}
    assert sorted(by_count) == [1, 2, 3, 5]
    assert by_count[5] > by_count[1]
    page = (tmp_path / "out" / "report.html").read_text()
    for words in ("λ = π/2", "similarity against the number of fitted presses", "validation losses"):
        assert words in page


@pytest.mark.parametrize(("off_mm", "named"), [(0.2, True), (0.05, False)])
def test_commanded_and_reached_depth_stand_side_by_side_and_a_large_difference_is_named(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, off_mm: float, named: bool
) -> None:
    records = Recording.stroke_records

    def reached(recording: Recording) -> Iterator[Stroke]:
        for number, stroke in enumerate(records(recording)):
            depth = None if number == 0 else stroke.depth_mm - (off_mm if number == 3 else 0.01)
            yield stroke.model_copy(update={"reached_mm": depth})

    monkeypatch.setattr(Recording, "stroke_records", reached)
    output = brushloop.validate(session, models=("ccd-bsm",), held_out=False, out=tmp_path / "validation")
    rows = {row["stroke_id"]: row for row in rows_of(tmp_path / "validation" / "scores.csv")}
    assert rows["0"]["reached_mm"] == ""
    assert float(rows["3"]["depth_mm"]) - float(rows["3"]["reached_mm"]) == pytest.approx(off_mm)
    assert any(" 3: " in point.text and "was reached" in point.text for point in trust(output.report)) == named


def test_what_was_left_out_selected_or_pressed_on_other_paper_stands_above_the_results(report: Report) -> None:
    def shown(**changes: object) -> str:
        collected = Collected(
            planned=8, photographed=8, pressed_again=(), left_out=(), touches=("taught 1 mm",), moved_mm=0.0
        )
        session = report.sessions[0].model_copy(update={"collected": collected.model_copy(update=changes)})
        changed = report.model_copy(update={"sessions": (session,)})
        counted = templates().get_template("parts.html.j2").module.counted(session)
        return " ".join([*(point.text for point in trust(changed)), counted])

    assert "left out during" not in shown()
    assert "8 planned, 8 photographed" in shown()
    assert "2 of 8 planned strokes were left out during collection: a, b." in shown(left_out=("a", "b"))
    assert "1 of 8 photographed strokes were pressed again, after a failed check" in shown(pressed_again=("a",))
    touches = ("taught 1 mm", "jog 3 mm")
    assert "two zero touches differ by 2.00 mm (taught 1 mm, jog 3 mm)" in shown(moved_mm=2.0, touches=touches)


def test_takes_that_did_not_count_are_distinguished_from_strokes_that_were_left_out(tmp_path: Path) -> None:
    a, b, c = (Pressed(stroke_id=name, condition=Condition(depth_mm=13.0, tilt_deg=5.0)) for name in "abc")
    header = Header(session_id="taken", source=Source.LOOPBACK, software="test")
    store = SessionStore.create(tmp_path / "taken", header, {}, itertools.count(1).__next__)
    results = (
        ZeroTouchResult(method="taught", touch_z_mm=120.0),
        CaptureResult(press=a, still=1, kept=False, retake=True),
        CaptureResult(press=a, still=2),
        CaptureResult(press=b, still=3, kept=False),
        DipResult(skipped=c),
        ZeroTouchResult(method="jog", touch_z_mm=122.0),
    )
    for number, result in enumerate(results):
        store.done(store.begin(f"k{number}", result.kind), result)
    store.close()
    store.release()
    collected = collected_in(store.folder)
    assert collected is not None
    assert (collected.photographed, collected.pressed_again, collected.left_out) == (3, ("a",), ("b", "c"))
    assert collected.touches == ("taught 120.00 mm", "jog 122.00 mm")
    assert collected.moved_mm == pytest.approx(2.0)
    assert collected_in(tmp_path) is None


TWO = ("--model", "line", "--model", "ellipse", "--no-held-out")


@pytest.fixture(scope="module")
def before(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("before")
    said("validate", session, "--out", out, *TWO, left_out=True)
    return out


def test_another_version_of_a_model_is_compared_stroke_by_stroke(
    session: Path, before: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validation, "simulated", lambda model, *at: images_of(model.profile(*at), -9.0))
    said("validate", session, "--out", tmp_path, *TWO, left_out=True)
    found = compare(DiffRequest(before, tmp_path / "report.json"))
    assert found.by_stroke
    assert len(found.changes) == 3 * 4 * 2
    changes = {change.series: change for change in found.changes}
    same = changes[("another press", "mm", "binary", "csim")]
    assert (same.test.mean, same.verdict) == (0.0, "no significant difference")
    # Every mark is drawn 9 mm too far to the left, in each of the five conditions.
    worse = changes[("line", "mm", "binary", "csim")]
    assert (worse.test.n, worse.test.groups) == (10, 5)
    assert worse.test.interval is not None
    assert worse.test.interval[1] < 0.0
    assert worse.test.p == pytest.approx(2 / 2**5)  # signs are flipped by condition: five alike are no proof yet
    assert worse.verdict == "no significant difference"
    table = said("validate", "diff", before, tmp_path)
    assert "the same stroke" in table
    assert "n = 10 in 5 conditions" in table


def test_two_sessions_are_compared_condition_by_condition(before: Path, tmp_path: Path) -> None:
    other = imported_presses(tmp_path, CONDITIONS * 2, name="other", seed=500)
    said("validate", other, *TWO)
    found = compare(DiffRequest(before, other))  # the session's own folder
    assert not found.by_stroke
    assert all(change.test.n == 5 for change in found.changes)
    assert {change.verdict for change in found.changes} == {"no significant difference"}


def test_what_has_no_report_or_an_edited_table_is_refused(session: Path, before: Path, tmp_path: Path) -> None:
    # A report of many sessions beside a session's folder is not that session's.
    shutil.copytree(session, tmp_path / "never", ignore=shutil.ignore_patterns("validation"))
    shutil.copytree(before, tmp_path / "validation")
    for never in (tmp_path / "never", tmp_path / "never" / "presses.mcap"):
        with pytest.raises(CalibrationError, match=f"{never}: was not validated: run `brushloop validate {never}`"):
            compare(DiffRequest(before, never))
    with pytest.raises(CalibrationError, match="nowhere: was not validated"):
        compare(DiffRequest(tmp_path / "nowhere", before))
    edited = tmp_path / "validation" / "scores.csv"
    edited.write_text(edited.read_text().replace("0.9", "0.8"))
    with pytest.raises(CalibrationError, match="its SHA-256 differs"):
        compare(DiffRequest(before, tmp_path / "validation"))


def test_headline_verdict_and_ceiling_are_of_the_presses_whose_condition_was_pressed_twice(tmp_path: Path) -> None:
    partly = imported_presses(tmp_path, CONDITIONS + CONDITIONS[:2], name="partly")
    output = said("validate", partly, *QUICK)
    folder = partly / "validation"
    report = Report.read(folder)
    csim = report.stat("line").csim
    assert (csim.n, csim.below_n) == (7, 4)
    of_line, of_ceiling = (round(percent, 1) for _, percent in headline(report))
    assert of_line != round(csim.avg, 1)
    sentence = (folder / "verdict.txt").read_text().strip()
    assert f"average CSIM of {of_line} % (over the 4 of 7 presses whose condition" in sentence
    assert f"{of_ceiling - of_line:.1f} points" in sentence
    assert f"ceiling of {of_ceiling} %" in sentence
    page = (folder / "report.html").read_text()
    assert sentence in page
    assert f"<b>{of_line} %</b>" in page
    assert " ".join(sentence.split()) in output


def test_without_a_repeated_condition_it_is_said_that_the_question_has_no_answer(tmp_path: Path) -> None:
    said("validate", once := imported_presses(tmp_path, CONDITIONS[:3], name="once"), *QUICK)
    assert (once / "validation" / "verdict.txt").read_text().startswith("It cannot be said: no condition was")


def test_strokes_that_are_left_out_end_in_exit_code_3_after_the_report(tmp_path: Path) -> None:
    imported_presses(tmp_path, CONDITIONS[:2], name="some", blank=True)
    ran = brushloop_process("analyse", tmp_path / "some")
    assert ran.returncode == 3, ran.stderr
    assert ran.stderr.endswith("strokes could not be used and were left out: 1\n")
    assert (tmp_path / "some" / "validation" / "report.html").is_file()
