"""Dragged strokes: from photographs to a drag model on disk and a report; loopback brush and drawn strokes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from brushloop.calibrate.artefact import current
from brushloop.calibrate.drags import MM_PER_PX, Drag, Drags, along_axis, commanded_path, defects, read_drags
from brushloop.calibrate.drags.fit import (
    FOLDS,
    LAG,
    PREDICTED,
    SPREAD_MM,
    DragArtefact,
    Kept,
    different,
    fit_drags,
    fit_values,
    model_of,
    predicted,
)
from brushloop.calibrate.drags.report import summary, validate_drags, width_sentence, write_drags
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stroke.preprocess import Measured, measure
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Waypoint
from brushloop.model.drag import DragModel, Drawings, ink, lagging
from brushloop.sessions.records import Header, Source, Stroke
from tests.calibrate.given import rows_of
from tests.command import brushloop, refused, said
from tests.photographed import imported, photograph

DATA = Path(__file__).parents[3] / "shared" / "data"

STROKES = [
    (30.0, 0.0, 4.0),
    (30.0, 12.0, 7.0),
    (25.0, -12.0, 5.0),
    (35.0, 8.0, 8.0),
    (28.0, -8.0, 3.0),
    (32.0, 15.0, 6.0),
]
LEFT, TOP = 200, 250


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    lines = ["file,length_mm,bend_mm,depth_mm,px_per_mm,start_x_px,start_y_px"]
    brush = Brush(BrushSpec())
    for k, (length, bend, depth) in enumerate(STROKES):
        path = commanded_path(length, bend, depth, depth)
        mark = brush.drag([Waypoint(*row) for row in path.tolist()], 0.0, 0.0, ink_load=1.0, press_seed=k)
        photograph(folder / f"{k}.png", mark, (500, 620), (200, 250))
        lines.append(f"{k}.png,{length},{bend},{depth},10.0,200,250")
    return imported(folder, lines, tmp_path_factory.mktemp("sessions") / "drags", "drag")


def fit_command(session: Path, *more: str) -> tuple[Path, str]:
    """The artefact that `brushloop fit` writes for drags, and what it prints."""
    output, path = said("fit", session, *more), current(session, DragArtefact.FOLDER)
    assert path is not None
    return path, output


@pytest.fixture(scope="module")
def fitted(session: Path) -> tuple[Path, str]:
    """Fitted once, for whoever only reads it."""
    return fit_command(session)


def test_dragged_strokes_are_fitted_and_written(session: Path, fitted: tuple[Path, str]) -> None:
    path, output = fitted
    for words in ("bristle lag alone", "leash_mm", "not determined", "as in the middle"):
        assert words in output
    fit = DragArtefact.read(path)
    assert len(fit.fitted_strokes) == 6
    assert fit.held_out.keys() == {PREDICTED, LAG}
    assert all(csim > 80.0 for csim, _ in fit.held_out.values())
    model = model_of(fit.parameters)
    assert model.leash_mm + 6.0 * model.leash_per_mm > 1.0
    assert fit.parameters["half_mm"].low is not None
    assert fit.parameters["settle_mm"].low is None  # each depth is constant along its path


def test_another_session_is_predicted_stroke_by_stroke(session: Path, fitted: tuple[Path, str], tmp_path: Path) -> None:
    """Here the session itself, so that the report has to say that the fit is to these strokes."""
    out = tmp_path / "report"
    output = said("validate", session, "--fit", fitted[0], "--out", out)
    page = (out / "report.html").read_text()
    for words in ("bristle lag alone", "In sample", "No stroke was repeated", "captured and predicted ink"):
        assert words in page
    assert re.findall(r'<script|(?:src|href)="(?!data:image/)', page) == [], "it fetches nothing"
    assert "from a fit to these strokes" in output
    report = json.loads((out / "report.json").read_text())
    assert report["source"] == "imported photographs"
    assert report["over_all"][PREDICTED]["csim"] > 0.8
    assert len(report["strokes"]) == 6


def test_a_known_brush_is_adapted_to_few_strokes(session: Path, fitted: tuple[Path, str]) -> None:
    before = DragArtefact.read(fitted[0])
    options = ("--prior", str(fitted[0]), "--strokes")
    first, again = (fit_command(session, *options, "2")[0] for _ in range(2))
    assert first == again, "equal inputs give an equal file"
    adapted = DragArtefact.read(first)
    assert (adapted.prior, len(adapted.fitted_strokes)) == (before.digest, 2)
    assert adapted.parameters["settle_mm"] == before.parameters["settle_mm"]
    assert adapted.refitted[:2] == ("half_mm", "half_per_mm")
    assert adapted.kept is None  # what the lag missed belongs to the other session
    path, output = fit_command(session, *options, "1")
    assert "drift_x_mm" in output
    one = DragArtefact.read(path)
    assert one.parameters["drift_x_mm"].low is None  # a single stroke has no interval, not one of width zero
    assert "allowed: 1 to 6" in refused("fit", session, *options, "7")


def test_an_edited_file_hostile_ink_and_presses_are_refused_with_one_line(
    session: Path, fitted: tuple[Path, str], tmp_path: Path
) -> None:
    fit = DragArtefact.read(fitted[0])
    assert fit.kept is not None
    for old, new, words in (('"leash_mm"', '"leash_m"', "leash_mm"), (fit.kept.ink, "aGVsbG8=", "ink cannot be read")):
        edited = tmp_path / fitted[0].name
        edited.write_text(fitted[0].read_text().replace(old, new))
        with pytest.raises(CalibrationError, match=words):
            DragArtefact.read(edited)
    assert "holds drags" in refused("recover", session)
    assert "validate one such session at a time" in refused("validate", session, session)


@pytest.fixture(scope="module")
def drags(session: Path) -> Drags:
    return read_drags(session)


def test_the_ink_lies_where_the_command_put_it(drags: Drags) -> None:
    straight = next(drag.ink for drag in drags.placed if drag.stroke.stroke_id == "0") > 0.5
    x, y = drags.grid[0][straight.any(axis=0)], drags.grid[1][straight.any(axis=1)]
    assert -12.0 < x.min() < 2.0
    assert 20.0 < x.max() < 36.0
    assert abs(float(y.mean())) < 2.0


def page(defect: str) -> np.ndarray:
    """A stroke of 40 x 5 mm on gray paper, 10 px/mm."""
    image = np.full((500, 800), 185, np.uint8)
    cv2.rectangle(image, (LEFT, TOP - 25), (LEFT + 400, TOP + 25), 30, -1)
    match defect:
        case "torn":
            image[:, LEFT + 150 : LEFT + 190] = 185
        case "hollow":
            image[TOP - 17 : TOP + 17, LEFT + 8 : LEFT + 392] = 185
        case "glare":
            cv2.circle(image, (LEFT + 100, 80), 30, 253, -1)
        case "cut":
            image[:, LEFT + 370 : LEFT + 390] = 185
            image[TOP - 25 : TOP + 25, LEFT + 390 :] = 30
    return image


def test_defects_are_listed_and_the_source_is_told_everywhere(tmp_path: Path) -> None:
    """One whole stroke, three with a defect, and one that the photograph cuts."""
    lines = ["file,length_mm,depth_mm,px_per_mm,start_x_px,start_y_px"]
    for k, name in enumerate(("whole", "torn", "hollow", "glare", "cut")):
        cv2.imwrite(str(tmp_path / f"{name}.png"), page(name))
        lines.append(f"{name}.png,40,{3 + k},10,{LEFT},{TOP}")
    validation = validate_drags(imported(tmp_path, lines, tmp_path / "drags", "drag", simulated=True), None)
    drags = validation.drags
    assert [drags.placed[k].stroke.stroke_id for k in drags.sound] == ["whole"]
    assert [name for name, _ in drags.left_out] == ["cut"]
    html = write_drags(validation, tmp_path, "test").read_text()
    lines = "\n".join(line for line in summary(validation) if isinstance(line, str))
    for words in ("torn: torn: 2 parts", "hollow: hollow: ink covers", "glare: glare:"):
        assert words in html
        assert f"not fitted: {words}" in lines
    assert html.count("imported simulation") >= 3
    assert "imported photographs" not in html
    rows = {row["stroke_id"]: row for row in rows_of(tmp_path / "measured.csv")}
    assert [name for name, row in rows.items() if row["cut"] == "1"] == ["cut"]
    assert rows["whole"]["source"] == "imported simulation"


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0, -60.0])
def test_the_length_of_a_stroke_is_along_its_own_axis(angle_deg: float) -> None:
    box = np.rint(cv2.boxPoints(((300.0, 300.0), (400.0, 60.0), angle_deg))).astype(np.int32)
    bar = cv2.fillPoly(np.zeros((600, 600), np.uint8), [box], 1).astype(bool)
    size = measure(along_axis(bar))
    assert (size.length_mm, size.width_mm) == pytest.approx((20.0, 3.0), abs=0.25)
    assert defects(bar) == ()


@pytest.mark.skipif(not DATA.is_dir(), reason="the folders of real photographs are not here")
@pytest.mark.parametrize(
    ("name", "strokes", "code", "least"),
    [
        # One of these photographs is blank, and some strokes are bent.
        ("frida_bigbrush_tilt_16x20", 31, 3, {"length_mm": 0.95, "depth_mid_mm_nominal": 0.8}),
        # Specks and neighbours: their bounding box follows the command with r = .12 only.
        pytest.param("frida_ink_10x8", 24, 0, {"length_mm": 0.9}, marks=pytest.mark.soak),
    ],
)
def test_real_dragged_strokes_are_all_found_and_follow_their_commands(
    tmp_path: Path, name: str, strokes: int, code: int, least: dict[str, float]
) -> None:
    """Every sixth photograph of each set, by the correlation of what was commanded and measured."""
    table = tmp_path / "strokes.csv"
    head, *lines = (DATA / name / "strokes.csv").read_text().splitlines()
    table.write_text("\n".join([head, *lines[::6]]) + "\n")
    imported = brushloop("sessions", "import", DATA / name, "--csv", table, "--kind", "drag", cwd=tmp_path)
    assert imported.returncode == 0, imported.stderr
    ran = brushloop("validate", tmp_path / "sessions" / name, cwd=tmp_path)
    assert ran.returncode == code, ran.stderr
    rows = rows_of(tmp_path / "sessions" / name / "validation" / "measured.csv")
    assert len(rows) == strokes
    for command, correlation in least.items():
        size = {"length_mm": "measured_length_mm"}.get(command, "measured_mid_width_mm")
        pairs = np.array([(float(row[f"commanded_{command}"]), float(row[size])) for row in rows])
        assert np.corrcoef(pairs.T)[0, 1] > correlation


# The fit alone: lag, place and what both miss are found again in ink that a known brush has drawn

X_MM, Y_MM = np.arange(-10.0, 50.0, MM_PER_PX), np.arange(18.0, -18.0, -MM_PER_PX)
TRUTH = DragModel(half_mm=1.5, half_per_mm=0.4, leash_mm=3.0, leash_per_mm=0.5, drift_y_mm=0.5, settle_mm=2.0)


def arcs(count: int, seed: int) -> list[np.ndarray]:
    """Commanded paths of any length, bend and depth; the depth is constant along each."""
    length, bend, depth = np.random.default_rng(seed).uniform([20.0, -9.0, 3.0], [35.0, 9.0, 9.0], (count, 3)).T
    return [commanded_path(*command) for command in zip(length, bend, depth, depth, strict=True)]


def drawings(paths: list[np.ndarray], model: DragModel = TRUTH) -> Drawings:
    """What that brush draws, as chances of ink."""
    away = lagging(paths, model.vector()).distances(X_MM, Y_MM)
    return Drawings(paths, np.arange(len(paths) + 1), ink(away, SPREAD_MM).astype(np.float32), X_MM, Y_MM)


def repeated(conditions: int, repeats: int, mm_up: list[int] | None = None, flawed: tuple[int, ...] = ()) -> Drags:
    """An imported session in which each command was drawn several times; each image is moved up by some mm."""
    length, bend = np.linspace(20.0, 35.0, conditions), np.linspace(-9.0, 9.0, conditions)
    commands = [(a, b, 5.0, 5.0, 0.0) for a, b in zip(length, bend, strict=True) for _ in range(repeats)]
    images = drawings([commanded_path(*command[:4]) for command in commands]).ink > 0.5
    strokes = []
    for k, (command, image, by) in enumerate(zip(commands, images, mm_up or [0] * len(commands), strict=True)):
        stroke, flags = Stroke(stroke_id=str(k), kind="drag", still=k), ("torn",) if k in flawed else ()
        ink = np.roll(image, round(by / MM_PER_PX), axis=0).astype(np.float32)
        strokes.append(Drag(stroke, command, Measured(1.0, 1.0, 1.0, 1.0, 1.0), False, flags, np.zeros((1, 1)), ink))
    header = Header(session_id="s", source=Source.IMPORT, software="test", protocol="")
    session = OpenSession(SimpleNamespace(header=header), "", (), None, None)
    return Drags(session, strokes, [], (X_MM, Y_MM), "")


def test_lag_and_width_are_found_again() -> None:
    values = fit_values(drawings(arcs(12, 1)).every(2))
    model, half_mm = model_of(values), values["half_mm"]
    for depth in (4.0, 8.0):
        assert model.leash_mm + model.leash_per_mm * depth == pytest.approx(3.0 + 0.5 * depth, rel=0.15)
    assert np.abs(drawings(arcs(4, 2), model).ink - drawings(arcs(4, 2)).ink).mean() < 0.01
    assert half_mm.low is not None
    assert half_mm.high is not None
    assert half_mm.low < half_mm.value < half_mm.high
    assert values["settle_mm"].low is None  # the depth is constant along each path


def test_what_the_model_lacks_is_learned_from_neighbours() -> None:
    """Strokes that lie the higher the more they bend: the correction knows those between the ones that it has seen."""
    moved = repeated(17, 1, np.linspace(-2, 2, 17).round().astype(int).tolist())
    even, odd = np.arange(0, 17, 2), np.arange(1, 17, 2)
    rows = predicted(TRUTH, Kept.of(moved, even), moved, odd)
    corrected, alone = (np.count_nonzero(rows[name] != (moved.drawings.ink[odd] > 0.5)) for name in (PREDICTED, LAG))
    assert corrected < 0.7 * alone


def test_repeats_of_a_command_and_strokes_with_a_defect_are_not_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted, of = list[set[int]](), Kept.of

    def watched(session: Drags, images: np.ndarray) -> Kept:
        fitted.append(set(images.tolist()))
        return of(session, images)

    monkeypatch.setattr(Kept, "of", watched)
    artefact = fit_drags(repeated(6, 2, flawed=(11,)))
    assert len(fitted) == FOLDS + 1
    assert "11" not in artefact.fitted_strokes
    assert all(11 not in images for images in fitted)
    assert all(k in images for images in fitted for k in range(10) if k ^ 1 in images)


def test_a_brush_is_adapted_to_strokes_that_differ_most() -> None:
    commands = np.array([[20.0, 5.0, 2.0, 2.0, 0.0]] * 6 + [[40.0, -5.0, 4.0, 4.0, 0.0], [20.0, -5.0, 4.0, 4.0, 0.0]])
    assert sorted(different(commands, 3)) == [3, 6, 7]
    alike = np.array([[20.0, 5.0, 2.0, 2.0, 0.0]] * 9)
    assert sorted(different(alike, 3)) == [0, 4, 8], "strokes from one part of the page share its error"


def test_the_commanded_path_is_the_curve_of_its_four_control_points() -> None:
    path = commanded_path(30.0, 12.0, 0.8 * 18.0, 0.2 * 18.0)
    assert path[0].tolist() == pytest.approx([0.0, 0.0, 0.2 * 18.0])
    assert path[-1].tolist() == pytest.approx([30.0, 0.0, 0.2 * 18.0])
    assert path[:, 1].max() == pytest.approx(0.75 * 12.0, abs=0.02)
    assert path[:, 2].max() == pytest.approx(0.8 * 18.0)


def test_the_slope_of_width_against_depth_has_its_interval(drags: Drags, monkeypatch: pytest.MonkeyPatch) -> None:
    widths = np.array([[1.0, 3.0], [2.0, 3.6], [3.0, 3.9], [4.0, 4.5]])
    monkeypatch.setattr(Drags, "widths", lambda _: widths)
    # by hand: 2.4 / 5, and 4.303 standard errors of sqrt(0.018 / 2 / 5) on either side
    sentence = width_sentence(drags)
    assert "0.480 mm per mm of commanded depth (95 % 0.297 to 0.663) from +2.55 mm at depth 0" in sentence
    assert "r = 0.99, n = 4" in sentence
    monkeypatch.setattr(Drags, "widths", lambda _: widths * [0.0, 1.0])
    assert "No line was fitted" in width_sentence(drags)
