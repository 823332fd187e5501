"""`brushloop write`: what a plan holds, what comes out beside it, Table 3 as data, and what the next plan learns."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate import writing
from brushloop.calibrate.commands import PROTOCOL, PlanRequest, PracticeRequest
from brushloop.calibrate.compare import Alignment, Polarity, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing import (
    PICTURE,
    Figure,
    FootprintArtefact,
    Plan,
    PlannedBy,
    as_points,
    load_plan,
    planned_figure,
    read_wanted,
)
from brushloop.calibrate.writing.compare import (
    ANOTHER,
    HEADLINE,
    KEYS,
    PLANNED,
    REFERENCE,
    SIMULATED,
    Character,
    WritingComparison,
    WrittenRecord,
    aligned,
    compare_ink,
    round_of,
    write_written,
)
from brushloop.calibrate.writing.learn import FIGURES, MARGIN, fitted, learned, practice, practice_strokes
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.model.ccdbsm import Brush
from brushloop.model.characters.plan import (
    Patch,
    Reach,
    StrokePath,
    covered,
    drawn,
    first_lead,
    grid,
    lead,
    without_tilt,
)
from brushloop.model.drag import NAMES, START, Drawings, Footprint, inked
from brushloop.model.similarity import csim, ssim
from brushloop.model.strokes import stroke_model
from tests.calibrate.given import CALIBRATION, cross, opened, plan_of, written_record
from tests.command import brushloop, refused

MODEL = stroke_model("ccd-bsm", Brush())
PATCH = Patch()
BAR = {"strokes": ["M 100 400 L 900 400 L 900 480 L 100 480 Z"], "medians": [[[110, 440], [890, 440]]]}


def test_the_command_writes_a_protocol_within_reach_and_a_picture(tmp_path: Path) -> None:
    options = ["--steps", "2", "--repeats", "2", "--depth-range", "1", "5", "--tilt-range", "0", "6"]
    ran = brushloop("write", "plan", "子永", "--out", "plan", *options, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert "without ink" in ran.stdout
    protocol = load_protocol(tmp_path / "plan" / PROTOCOL)
    assert isinstance(protocol, WriteConfig)
    assert protocol.repeats == 2
    assert [(figure.name, len(figure.strokes)) for figure in protocol.figures] == [("子", 3), ("永", 5)]
    for stroke in (stroke for figure in protocol.figures for stroke in figure.strokes):
        points = np.array(stroke.points)
        assert points[:, 2].min() >= 1.0
        assert points[:, 2].max() <= 5.0
        assert points[:, 3].max() <= 6.0
        turned = np.abs(np.diff(points[:, 4]))
        assert np.all(turned <= 12.0 * np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1) + 0.05)
    picture = cv2.imread(str(tmp_path / "plan" / PICTURE))
    assert picture is not None
    assert picture.shape[1] == 1200


def test_refinement_raises_both_scores() -> None:
    [wanted] = read_wanted("永", None, PATCH)
    figure, first = planned_figure(wanted, MODEL, Reach(), PATCH, 5.0, 20)
    for measure, least in ((csim, 0.98), (ssim, 0.97)):
        assert measure(figure.wanted, figure.simulated) > max(measure(figure.wanted, first), least)


def test_a_data_set_is_a_folder_with_a_file_for_each_character(tmp_path: Path) -> None:
    (tmp_path / "一.json").write_text(json.dumps(BAR), encoding="utf-8")
    [figure] = read_wanted("一", tmp_path, PATCH)
    assert len(figure.paths) == 1
    assert figure.wanted.max() == 1.0
    protocol = load_protocol(writing.plan(PlanRequest("一", tmp_path / "out", data=tmp_path, steps=4)).path)
    assert isinstance(protocol, WriteConfig)
    points = protocol.figures[0].strokes[0].points
    _, _, depth_mm, tilt_deg, _ = points[len(points) // 2]
    wide_mm = 2.0 * figure.paths[0].half_width_mm.max()
    assert MODEL.profile(depth_mm, tilt_deg).width_mm[0] == pytest.approx(wide_mm, abs=0.5)
    for content, words in ((b"\xff\xfe", "'utf-8' codec can't decode"), (b"{}", "strokes: Field required")):
        (tmp_path / "一.json").write_bytes(content)
        with pytest.raises(CalibrationError, match=rf"一\.json: {words}"):
            read_wanted("一", tmp_path, PATCH)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("一",), "is not shipped (only 子 字 永)"),
        (("一", "--data", "nowhere"), "nowhere/一.json: no such file"),
        (("字字",), "a character occurs twice"),
        (("字", "--tilt-range", "0", "45"), "tilts must be at most 30 deg"),
        (("字", "--depth-range", "5", "5"), "depth_mm = (5, 5)"),
        (("字", "--depth-range", "1", "60"), "depth_mm = 60 is outside"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in refused("write", "plan", *arguments)
    assert list(tmp_path.iterdir()) == []


# What was written beside its plan


def test_size_normalised_forgives_place_and_size_and_mm_does_not() -> None:
    small = cv2.resize(cross(), (64, 64), interpolation=cv2.INTER_AREA)
    moved = np.zeros((128, 128), np.float32)
    moved[5:69, 50:114] = small
    inks = dict.fromkeys(Tone, cross()), dict.fromkeys(Tone, moved)
    for tone in Tone:
        near = compare_ink(*inks, (Alignment.SIZE_NORMALISED, tone, Polarity.INK))
        far = compare_ink(*inks, (Alignment.MM, tone, Polarity.INK))
        assert near[0] > 0.93
        assert far[0] < 0.5
    whole = aligned(cross(), Alignment.SIZE_NORMALISED) > 0.5
    assert np.ptp(np.flatnonzero(whole.any(axis=1))) + 1 == pytest.approx(100, abs=2)


def character(writings: int = 3) -> Character:
    captured = {f"x-r{k + 1:02d}": dict.fromkeys(Tone, cross(k)) for k in range(writings)}
    return Character(plan_of(reference="font of the test").figures[0], captured)


def test_table_3_has_a_row_for_each_comparison_and_survives_the_disk(tmp_path: Path) -> None:
    rows = WritingComparison(None, None, [character()]).table_3
    assert len(rows) == len(KEYS) * 4
    strict = {row.pair: row for row in rows if (row.alignment, row.tone, row.polarity) == HEADLINE}
    assert [strict[pair].csim.n for pair in (SIMULATED, REFERENCE, PLANNED, ANOTHER)] == [3, 3, 1, 3]
    csim = strict[REFERENCE].csim
    assert csim.max == pytest.approx(100.0)
    assert csim.max > csim.avg > csim.min
    assert strict[REFERENCE].reference == "font of the test"
    # The middle one is nearest to the two others, and a writing alone has no other.
    assert character().scores[ANOTHER, HEADLINE][:, 0].argmax() == 1
    assert ANOTHER not in {row.pair for row in WritingComparison(None, None, [character(1)]).table_3}

    (tmp_path / "written.json").write_text(written_record(table_3=rows).to_json())
    assert WrittenRecord.read(tmp_path).table_3 == rows


def test_a_plan_keeps_its_images_and_its_points(tmp_path: Path) -> None:
    plan = plan_of()
    text = plan.model_dump_json()
    (tmp_path / "plan.json").write_text(text)
    loaded = load_plan(tmp_path)
    assert loaded.model_dump_json() == text
    np.testing.assert_array_equal(loaded.figures[0].wanted, cross())
    # What the protocol holds has three decimals.
    assert loaded.figures[0].commanded == (((1, 2, 3, 4, 0), (5.5, 6.25, 7.125, 8, 9)),)
    picture = json.loads(text)["figures"][0]["wanted"]
    for old, new, words in ((picture, "AAAA", "figures.0.wanted: .*not a picture"), ("60.0", "NaN", "cell_mm")):
        (tmp_path / "plan.json").write_text(text.replace(old, new))
        with pytest.raises(CalibrationError, match=rf"plan\.json: {words}"):
            load_plan(tmp_path)


# What the next plan learns from it

SIDE_MM = 48.0
LINE = StrokePath(np.column_stack((np.linspace(12.0, 36.0, 9), np.full(9, 24.0))), np.full(9, 2.0))
X_MM, Y_MM = np.meshgrid(*grid(SIDE_MM, 128))
WANTED = (np.hypot(X_MM - np.clip(X_MM, 12.0, 36.0), Y_MM - 24.0) < 2.0).astype(np.float32)


def brush_of(**changed: float) -> Footprint:
    return Footprint(tuple({**dict(zip(NAMES, START, strict=True)), **changed}.values()))


KNOWN = brush_of()
TRUE = brush_of(half_mm_2=-0.1, leash_mm=1.2, across_mm=0.6)
"""The brush that writes: thinner, farther behind and farther to the left than the one that the plan knows."""


@pytest.fixture(scope="module")
def plan() -> Plan:
    by = PlannedBy(footprint=KNOWN.values)
    strokes = first_lead([LINE], KNOWN, by.reach, SIDE_MM, 5.0)
    strokes = lead([KNOWN], strokes, WANTED, SIDE_MM, by.reach)
    median = tuple((x, y, 2.0) for x, y in LINE.points.tolist())
    seen = {"wanted": WANTED, "simulated": WANTED}
    figure = Figure(name="bar", source="test", commanded=as_points(strokes), medians=(median,), **seen)
    return Plan(model="footprint", planned_by=by, cell_mm=SIDE_MM, software="test", figures=(figure,))


def came_out(plan: Plan) -> np.ndarray:
    return covered(drawn([TRUE], plan.figures[0].strokes, SIDE_MM, 128), SIDE_MM)


def session(plan: Plan, name: str = "bar", ink: np.ndarray | None = None) -> WritingComparison:
    seen = came_out(plan) if ink is None else ink
    figure = plan.figures[0].model_copy(update={"name": name})
    character = Character(figure, {f"{name}-r01": dict.fromkeys(Tone, seen)})
    return WritingComparison(opened("s", Path("s.mcap"), calibration=CALIBRATION), plan, [character])


@pytest.fixture(scope="module")
def after(plan: Plan) -> Plan:
    return learned(session(plan))


def test_a_round_brings_the_ink_to_where_it_was_wanted(plan: Plan, after: Plan) -> None:
    def wrong(one: Plan) -> int:
        return np.count_nonzero((came_out(one) > 0.5) != (WANTED > 0.5))

    assert wrong(after) < 0.5 * wrong(plan)
    [found] = after.figures[0].rounds
    assert found.csim_percent < 90.0
    assert set(found.lost_percent) == {"initiation, hidden tip", "execution", "termination, hidden tip"}
    # The ink lay too far left, seen along the stroke to the right: above. The command goes below.
    assert after.figures[0].strokes[0][:, 1].mean() < plan.figures[0].strokes[0][:, 1].mean() - 0.3
    # What the plan knows of the brush is what the ink showed.
    assert after.planned_by.footprint is not None
    drift = dict(zip(NAMES, after.planned_by.footprint, strict=True))["across_mm"]
    assert drift == pytest.approx(0.6, abs=0.3)


def test_after_a_round_that_does_not_help_the_best_one_is_kept(plan: Plan, after: Plan) -> None:
    last = learned(session(after, ink=np.roll(came_out(after), 8, axis=0)))
    [figure] = last.figures
    assert figure.settled
    assert figure.commanded == figure.best == plan.figures[0].commanded
    assert len(figure.rounds) == 2
    # Once settled it stays, whatever the next round shows.
    assert learned(session(last, ink=WANTED)).figures[0].settled
    with pytest.raises(CalibrationError, match="shows no 'bar'"):
        learned(session(plan, "other"))


def test_the_report_lists_rounds_and_what_each_phase_lost(after: Plan, tmp_path: Path) -> None:
    written = session(after)
    page = write_written(written, tmp_path, "brushloop write compare").read_text(encoding="utf-8")
    assert "bar: wrong pixels (missing or too much) by phase of the strokes" in page
    assert "<th>phase</th><th>round 1</th><th>these writings</th>" in page
    assert "<td>initiation, hidden tip</td>" in page


def test_what_is_lost_is_listed_by_phase(plan: Plan) -> None:
    cut = WANTED.copy()
    cut[:, :40] = 0.0  # the first 3 mm of the stroke and its rounding are missing
    lost = round_of(session(plan, ink=cut).characters[0], SIDE_MM).lost_percent
    assert max(lost, key=lambda phase: lost[phase]) == "initiation, hidden tip"
    assert lost["termination, hidden tip"] == 0.0


# The practice sheet, and the footprint that its ink becomes

PATCH_MM = 70.0


def test_a_practice_sheet_is_a_protocol_that_stays_inside_its_patches(tmp_path: Path) -> None:
    protocol = load_protocol(practice(PracticeRequest(tmp_path)).path)
    assert isinstance(protocol, WriteConfig)
    assert len(protocol.figures) == FIGURES
    points = np.concatenate([np.array(stroke.points) for one in protocol.figures for stroke in one.strokes])
    assert points[:, :2].min() >= MARGIN * PATCH_MM - 1e-3
    assert points[:, :2].max() <= (1.0 - MARGIN) * PATCH_MM + 1e-3
    assert points[:, 2].max() <= 14.0


def test_figures_become_a_footprint() -> None:
    true = brush_of(half_mm_2=0.8)
    paths = [without_tilt(stroke) for stroke in practice_strokes(PATCH_MM, Reach(), 34.0)[:4]]
    x_mm, y_mm = grid(PATCH_MM, 70)
    ink = np.array([inked([true] * 2, paths[k : k + 2], x_mm, y_mm) > 0.0 for k in (0, 2)], np.float32)
    footprint, csim_percent = fitted(Drawings(paths, np.array([0, 2, 4]), ink, x_mm, y_mm))
    assert csim_percent > 95.0
    values = dict(zip(NAMES, footprint.values, strict=True))
    about = {"session_id": "practice-01", "source": "loopback rig", "recording_sha256": "", "calibration": ""}
    fields = about | {"software": "test", "images": 2, "strokes": 4, "csim_percent": csim_percent}
    assert FootprintArtefact.model_validate(fields | {"values": values}).footprint() == footprint
    with pytest.raises(ValueError, match="fit the session again with `brushloop write fit`"):
        FootprintArtefact.model_validate(fields | {"values": {"drift_along_mm": 0.0}})
