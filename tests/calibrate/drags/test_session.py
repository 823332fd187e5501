"""From photographs of dragged strokes to a drag model on disk and a report; loopback brush and drawn strokes."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.drags import along_axis, commanded_path, defects, read_drags
from brushloop.calibrate.drags.fit import FOLDER, LAG, PREDICTED, DragArtefact
from brushloop.calibrate.drags.report import summary, validate_drags, write_drags
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stroke import measure
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Waypoint
from tests.command import brushloop
from tests.photographed import imported, photograph

DATA = Path(__file__).parents[4] / "shared" / "data"

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
        photograph(folder / f"{k}.png", mark, (700, 900), (300, 350))
        lines.append(f"{k}.png,{length},{bend},{depth},10.0,300,350")
    return imported(folder, lines, tmp_path_factory.mktemp("sessions") / "drags", "drag")


def fit_command(session: Path, *more: str) -> tuple[Path, str]:
    """The artefact that `brushloop fit` writes for drags, and what it prints."""
    ran = CliRunner().invoke(app, ["fit", str(session), *more])
    assert ran.exit_code == 0, ran.output
    path = current(session, FOLDER)
    assert path is not None
    return path, " ".join(ran.output.split())


@pytest.fixture(scope="module")
def fitted(session: Path) -> tuple[Path, str]:
    """Fitted once, for whoever only reads it."""
    return fit_command(session)


def test_dragged_strokes_are_fitted_and_written(session: Path, fitted: tuple[Path, str]) -> None:
    path, output = fitted
    for words in ("bristle lag alone", "leash_mm", "not determined", "no depth at the ends"):
        assert words in output
    fit = load_artefact(path, DragArtefact)
    assert len(fit.fitted_strokes) == 6
    assert fit.held_out.keys() == {PREDICTED, LAG}
    assert all(csim > 80.0 for csim, _ in fit.held_out.values())
    assert fit.model().leash_mm + 6.0 * fit.model().leash_per_mm > 1.0
    assert fit.parameters["half_mm"].low is not None
    assert fit.parameters["settle_mm"].low is None  # each depth is constant along its path
    assert fit_command(session)[0] == path, "equal inputs give an equal file"


def test_another_session_is_predicted_stroke_by_stroke(session: Path, fitted: tuple[Path, str], tmp_path: Path) -> None:
    """Here the session itself, so that the report has to say "in sample"."""
    out = tmp_path / "report"
    ran = CliRunner().invoke(app, ["validate", str(session), "--fit", str(fitted[0]), "--out", str(out)])
    assert ran.exit_code == 0, ran.output
    page = (out / "report.html").read_text()
    for words in ("bristle lag alone", "In sample", "No command was repeated", "captured and predicted ink"):
        assert words in page
    assert re.findall(r'<script|(?:src|href)="(?!data:image/)', page) == [], "it fetches nothing"
    assert "in sample" in " ".join(ran.output.split())
    said = json.loads((out / "report.json").read_text())
    assert said["source"] == "imported photographs"
    assert said["over_all"][PREDICTED]["csim"] > 0.8
    assert len(said["strokes"]) == 6


def test_a_known_brush_is_adapted_to_few_strokes(session: Path, fitted: tuple[Path, str]) -> None:
    before = load_artefact(fitted[0], DragArtefact)
    options = ("--prior", str(fitted[0]), "--strokes")
    adapted = load_artefact(fit_command(session, *options, "2")[0], DragArtefact)
    assert (adapted.prior, len(adapted.fitted_strokes)) == (before.digest, 2)
    assert adapted.parameters["settle_mm"] == before.parameters["settle_mm"]
    assert adapted.refitted[:2] == ("half_mm", "half_per_mm")
    assert adapted.kept is None  # what the lag missed belongs to the other session
    path, output = fit_command(session, *options, "1")
    assert "drift_x_mm" in output
    one = load_artefact(path, DragArtefact)
    assert one.parameters["drift_x_mm"].low is None  # a single stroke has no interval, not one of width zero
    many = CliRunner().invoke(app, ["fit", str(session), *options, "7"])
    assert "allowed 1 to 6" in str(many.exception)


def test_an_edited_file_hostile_ink_and_presses_are_refused_with_one_line(
    session: Path, fitted: tuple[Path, str], tmp_path: Path
) -> None:
    fit = load_artefact(fitted[0], DragArtefact)
    assert fit.kept is not None
    for old, new, words in (('"leash_mm"', '"leash_m"', "leash_mm"), (fit.kept.ink, "aGVsbG8=", "ink cannot be read")):
        edited = tmp_path / fitted[0].name
        edited.write_text(fitted[0].read_text().replace(old, new))
        with pytest.raises(CalibrationError, match=words):
            load_artefact(edited, DragArtefact)
    ran = CliRunner().invoke(app, ["recover", str(session)])
    assert ran.exit_code != 0
    assert "drags" in str(ran.exception)


def test_the_ink_lies_where_the_command_put_it(session: Path) -> None:
    drags = read_drags(session)
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
        case _:
            pass
    return image


@pytest.fixture(scope="module")
def flawed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One whole stroke, three with a defect, and one that the photograph cuts."""
    folder = tmp_path_factory.mktemp("flawed")
    lines = ["file,length_mm,depth_mm,px_per_mm,start_x_px,start_y_px"]
    for k, name in enumerate(("whole", "torn", "hollow", "glare", "cut")):
        cv2.imwrite(str(folder / f"{name}.png"), page(name))
        lines.append(f"{name}.png,40,{3 + k},10,{LEFT},{TOP}")
    return imported(folder, lines, tmp_path_factory.mktemp("flawed-session") / "drags", "drag", simulated=True)


def test_defects_are_listed_and_the_source_is_told_everywhere(flawed: Path, tmp_path: Path) -> None:
    validation = validate_drags(flawed, None)
    drags = validation.drags
    assert [drags.placed[k].stroke.stroke_id for k in drags.sound] == ["whole"]
    assert [name for name, _ in drags.left_out] == ["cut"]
    html = write_drags(validation, tmp_path, "test").read_text()
    said = "\n".join(line for line in summary(validation) if isinstance(line, str))
    for words in ("torn: torn: 2 parts", "hollow: hollow: ink covers", "glare: glare:"):
        assert words in html
        assert f"not fitted: {words}" in said
    assert html.count("imported simulation") >= 3
    assert "imported photographs" not in html
    with (tmp_path / "measured.csv").open() as file:
        rows = {row["stroke_id"]: row for row in csv.DictReader(file)}
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
    ("name", "strokes", "least"),
    [
        # One of these photographs is blank, and some strokes are bent.
        ("frida_bigbrush_tilt_16x20", 31, {"length_mm": 0.95, "depth_mid_mm_nominal": 0.8}),
        # Specks and neighbours: their bounding box follows the command with r = .12 only.
        ("frida_ink_10x8", 24, {"length_mm": 0.9}),
    ],
)
def test_real_dragged_strokes_are_all_found_and_follow_their_commands(
    tmp_path: Path, name: str, strokes: int, least: dict[str, float]
) -> None:
    """Every sixth photograph of each set, by the correlation of what was commanded and measured."""
    table = tmp_path / "strokes.csv"
    head, *lines = (DATA / name / "strokes.csv").read_text().splitlines()
    table.write_text("\n".join([head, *lines[::6]]) + "\n")
    imported = brushloop("sessions", "import", DATA / name, "--csv", table, "--kind", "drag", cwd=tmp_path)
    assert imported.returncode == 0, imported.stderr
    ran = brushloop("validate", tmp_path / "sessions" / name, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    with (tmp_path / "sessions" / name / "validation" / "measured.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == strokes
    for command, correlation in least.items():
        size = {"length_mm": "measured_length_mm"}.get(command, "measured_mid_width_mm")
        pairs = np.array([(float(row[f"commanded_{command}"]), float(row[size])) for row in rows])
        assert np.corrcoef(pairs.T)[0, 1] > correlation
