"""From photographs of dragged strokes to a drag model on disk; loopback brush."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console  # noqa: TID251
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.drags.artefact import DragArtefact
from brushloop.calibrate.drags.captures import commanded_path, figures_of, read_drags
from brushloop.calibrate.drags.fit import SPREAD_MM, fit_drags
from brushloop.calibrate.drags.measure import validate_drags
from brushloop.calibrate.drags.predict import predictors
from brushloop.calibrate.drags.report import DragValidation, summary, write_drags
from brushloop.calibrate.drags.run import FOLDER, LAGGING, STAMPS
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stroke.params import Params
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Waypoint
from brushloop.model.drag import DragModel, distances, trails
from brushloop.model.drag import ink as chance
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Source
from tests.photographed import imported, photograph

STROKES = [
    (30.0, 0.0, 4.0),
    (30.0, 12.0, 7.0),
    (25.0, -12.0, 5.0),
    (35.0, 8.0, 8.0),
    (28.0, -8.0, 3.0),
    (32.0, 15.0, 6.0),
]


def away(model: DragModel, path: np.ndarray, x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
    """Signed distance in mm to the edge of one path's mark."""
    return distances(*trails([path], model.vector()), x_mm, y_mm)[0]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    lines = ["file,length_mm,bend_mm,depth_mm,px_per_mm,start_x_px,start_y_px"]
    brush = Brush(BrushSpec())
    for k, (length, bend, depth) in enumerate(STROKES):
        path = commanded_path(length, bend, depth, depth)
        mark = brush.drag([Waypoint(*row[:3]) for row in path.tolist()], 0.0, 0.0, ink_load=1.0, press_seed=k)
        photograph(folder / f"{k}.png", mark, (700, 900), (300, 350))
        lines.append(f"{k}.png,{length},{bend},{depth},10.0,300,350")
    return imported(folder, lines, tmp_path_factory.mktemp("sessions") / "drags", "drag")


def fit_command(session: Path) -> tuple[Path, str]:
    """The artefact that `brushloop fit --drags` writes, and what it prints."""
    ran = CliRunner().invoke(app, ["fit", str(session), "--drags", "--mm-per-px", "1.0"])
    assert ran.exit_code == 0, ran.output
    path = current(session, FOLDER)
    assert path is not None
    return path, ran.output


@pytest.fixture(scope="module")
def fitted(session: Path) -> tuple[Path, str]:
    """Fitted once, for whoever only reads it."""
    return fit_command(session)


def test_dragged_strokes_are_fitted_and_written(fitted: tuple[Path, str]) -> None:
    path, output = fitted
    for words in ("bristle lag", "circle stamps", "leash_mm", "condition"):
        assert words in output
    fit = load_artefact(path, DragArtefact)
    assert (fit.images, fit.strokes) == (6, 6)
    assert fit.held_out[LAGGING].csim_percent > fit.held_out[STAMPS].csim_percent + 2.0
    assert fit.model().leash_mm + 6.0 * fit.model().leash_per_mm > 1.0
    assert fit.parameters["half_mm"].low is not None
    assert fit.parameters["settle_mm"].low is None  # each depth is constant along its path
    assert "not determined" in output
    assert "no depth at the ends" in " ".join(output.split())


def test_another_session_is_predicted_stroke_by_stroke(session: Path, fitted: tuple[Path, str], tmp_path: Path) -> None:
    """Here the session itself, so that the report has to say "in sample"."""
    fit, _ = fitted
    out = tmp_path / "report"
    ran = CliRunner().invoke(app, ["validate", str(session), "--fit", str(fit), "--out", str(out)])
    assert ran.exit_code == 0, ran.output
    words = " ".join(ran.output.split())
    for part in ("circle stamps", "bristle lag alone", "predicted worst", "In sample", "No command was repeated"):
        assert part in words
    said = json.loads((out / "report.json").read_text())
    assert said["source"] == "imported photographs"
    assert said["over_all"]["predicted"]["csim"] > said["over_all"]["circle stamps"]["csim"]
    assert len(said["strokes"]) == 6
    assert "captured and predicted ink" in (out / "report.html").read_text()


def test_a_report_of_simulated_drags_says_so_everywhere(session: Path, tmp_path: Path) -> None:
    validation = DragValidation(
        Header(session_id="s", source=Source.IMPORT_SIMULATED, software="test", protocol=""),
        session / "drags.mcap",
        "",
        validate_drags(Recording(session).captures(), Params()),
    )
    page = write_drags(validation, tmp_path, "test").read_text()
    assert page.count("imported simulation") >= 3
    assert "imported photographs" not in page
    assert "imported simulation" in (tmp_path / "measured.csv").read_text()
    with io.StringIO() as narrow:
        Console(file=narrow, width=80).print(*summary(validation))
        heads = narrow.getvalue().split("┡")[0]
    for word in ("stroke", "cmd.", "length", "depth", "width", "middle", "area", "whole"):
        assert word in heads, f"the head {word} is broken"


def test_a_known_brush_is_adapted_to_few_strokes(session: Path, fitted: tuple[Path, str]) -> None:
    run, (prior, _) = CliRunner(), fitted
    ran = run.invoke(app, ["fit", str(session), "--drags", "--prior", str(prior), "--strokes", "2"])
    assert ran.exit_code == 0, ran.output
    adapted = load_artefact(current(session, FOLDER) or prior, DragArtefact)
    before = load_artefact(prior, DragArtefact)
    assert (adapted.prior, adapted.images) == (before.digest, 2)
    assert adapted.parameters["settle_mm"] == before.parameters["settle_mm"]
    assert adapted.refitted[:2] == ("half_mm", "half_per_mm")
    assert adapted.kept == before.kept
    alone = run.invoke(app, ["fit", str(session), "--drags", "--prior", str(prior), "--strokes", "1"])
    assert "drift_x_mm" in alone.output
    one = load_artefact(current(session, FOLDER) or prior, DragArtefact)
    assert one.parameters["drift_x_mm"].low is None  # a single stroke has no interval, not one of width zero
    many = run.invoke(app, ["fit", str(session), "--drags", "--prior", str(prior), "--strokes", "7"])
    assert "allowed 1 to 6" in str(many.exception)


def test_hostile_ink_in_an_artefact_is_refused(fitted: tuple[Path, str]) -> None:
    fit = load_artefact(fitted[0], DragArtefact)
    assert fit.kept is not None
    for ink in ("not base64!", fit.kept.ink[:40], ""):
        bad = fit.model_copy(update={"kept": fit.kept.model_copy(update={"ink": ink})})
        with pytest.raises(CalibrationError, match="kept: ink"):
            predictors(bad, "fit.json", fit.recording_sha256)


def test_equal_inputs_give_an_equal_file_and_an_edited_one_is_refused(
    session: Path, fitted: tuple[Path, str], tmp_path: Path
) -> None:
    path, _ = fit_command(session)
    assert path == fitted[0]
    edited = tmp_path / path.name
    edited.write_text(path.read_text().replace('"leash_mm"', '"leash_m"'))
    with pytest.raises(CalibrationError, match="leash_mm"):
        load_artefact(edited, DragArtefact)


def test_presses_are_refused_with_one_line(session: Path) -> None:
    ran = CliRunner().invoke(app, ["fit", str(session)])
    assert ran.exit_code != 0
    assert "drags" in str(ran.exception)
    ran = CliRunner().invoke(app, ["fit", str(session), "--drags", "--correction"])
    assert ran.exit_code == 2


def test_the_ink_lies_where_the_command_put_it(session: Path) -> None:
    drawn = read_drags(session, 1.0)
    assert drawn.ink.shape == (6, len(drawn.y_mm), len(drawn.x_mm))
    straight = drawn.ink[drawn.stroke_ids.index("0")] > 0.5
    x, y = drawn.x_mm[straight.any(axis=0)], drawn.y_mm[straight.any(axis=1)]
    assert -12.0 < x.min() < 2.0
    assert 20.0 < x.max() < 36.0
    assert abs(float(y.mean())) < 2.0


def test_a_drawn_figure_has_the_strokes_of_its_protocol() -> None:
    points = [[1.0, 2.0, 3.0, 4.0, 90.0], [5.0, 6.0, 7.0, 8.0, 90.0]]
    protocol = {"kind": "write", "figures": [{"name": "yong", "strokes": [{"points": points}, {"points": points}]}]}
    found = figures_of(_header(json.dumps(protocol)))
    assert [path.tolist() for path in found["yong"]] == [[[1.0, 2.0, 3.0, 90.0], [5.0, 6.0, 7.0, 90.0]]] * 2
    with pytest.raises(CalibrationError, match="holds no trajectories"):
        figures_of(_header('{"kind": "grid"}'))


def test_figures_of_several_strokes_are_fitted_as_a_whole() -> None:
    truth = DragModel(half_mm=1.0, half_per_mm=0.4, leash_mm=3.0, leash_per_mm=0.4, drift_x_mm=0.5, settle_mm=2.0)
    x_mm, y_mm = np.arange(0.0, 60.0, 1.0), np.arange(59.0, -1.0, -1.0)
    rng = np.random.default_rng(4)
    paths = []
    for _ in range(8):
        for heading in (0.0, -90.0):  # a cross: one stroke to the right, one down, the brush turned with it
            way = (
                np.linspace(0.0, 1.0, 12)[:, None]
                * rng.uniform(22.0, 30.0)
                * np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading))])
            )
            start = np.array([15.0, 30.0]) if heading == 0.0 else np.array([30.0, 46.0])
            deep = np.full(12, rng.uniform(3.0, 8.0))
            paths.append(np.column_stack([start + way, deep, np.full(12, heading)]))
    groups = np.arange(0, 17, 2)
    ink = np.array(
        [np.maximum(*(chance(away(truth, p, x_mm, y_mm), SPREAD_MM) for p in paths[g : g + 2])) for g in groups[:-1]]
    )
    fit = fit_drags(paths, ink, x_mm, y_mm, groups=groups)
    for depth in (3.0, 8.0):
        assert fit.model.leash_mm + depth * fit.model.leash_per_mm == pytest.approx(3.0 + 0.4 * depth, rel=0.2)
    assert np.abs(chance(fit.distance(paths, x_mm, y_mm, groups=groups), SPREAD_MM) - ink).mean() < 0.01
    with pytest.raises(ValueError, match="not alike"):
        fit_drags(paths, ink, x_mm, y_mm)


def _header(protocol: str) -> Header:
    return Header(session_id="s", source=Source.LOOPBACK, software="test", protocol=protocol)
