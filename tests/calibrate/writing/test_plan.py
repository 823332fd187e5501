"""`brushloop write plan`: what it writes can be drawn by the rig, and bad input is one line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.commands import PlanRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing import PICTURE, PROTOCOL, plan, planned_figure, read_wanted
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import WriteConfig
from brushloop.model.ccdbsm import Brush
from brushloop.model.characters.plan import Patch, Reach
from brushloop.model.similarity import csim, ssim
from brushloop.model.strokes import stroke_model
from tests.command import brushloop

MODEL = stroke_model("ccd-bsm", Brush())
PATCH = Patch()
BAR = {"strokes": ["M 100 400 L 900 400 L 900 480 L 100 480 Z"], "medians": [[[110, 440], [890, 440]]]}


def test_the_command_writes_a_protocol_within_reach_and_a_picture(tmp_path: Path) -> None:
    options = ["--steps", "2", "--repeats", "2", "--depth-range", "1", "5", "--tilt-range", "0", "6"]
    ran = brushloop("write", "plan", "字永", "--out", "plan", *options, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert "not ink" in ran.stdout
    protocol = load_protocol(tmp_path / "plan" / PROTOCOL)
    assert isinstance(protocol, WriteConfig)
    assert protocol.repeats == 2
    assert [(figure.name, len(figure.strokes)) for figure in protocol.figures] == [("字", 6), ("永", 5)]
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
    for content, words in ((b"\xff\xfe", "'utf-8' codec can't decode"), (b"{}", "strokes: Field required")):
        (tmp_path / "一.json").write_bytes(content)
        with pytest.raises(CalibrationError, match=rf"一\.json: {words}"):
            read_wanted("一", tmp_path, PATCH)


def test_a_trajectory_is_planned_with_the_widths_it_asks_for(tmp_path: Path) -> None:
    rows = ["x_mm,y_mm,width_mm", "10,35,3", "60,35,3"]
    (tmp_path / "my line.csv").write_text("\n".join(rows))
    protocol = load_protocol(plan(PlanRequest(str(tmp_path / "my line.csv"), tmp_path / "out", steps=4)).path)
    assert isinstance(protocol, WriteConfig)
    assert protocol.figures[0].name == "my-line"
    points = protocol.figures[0].strokes[0].points
    _, _, depth_mm, tilt_deg, _ = points[len(points) // 2]
    assert MODEL.profile(depth_mm, tilt_deg).width_mm[0] == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("一",), "is not shipped (子 字 永)"),
        (("一", "--data", "nowhere"), "nowhere/一.json: no such file"),
        (("字字",), "the same character twice"),
        (("no.csv",), "no.csv: no such file"),
        (("字", "--tilt-range", "0", "45"), "tilts end at 30 deg"),
        (("字", "--depth-range", "5", "5"), "depth_mm = (5, 5)"),
        (("字", "--depth-range", "1", "60"), "depth_mm = 60 is outside"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = CliRunner().invoke(app, ["write", "plan", *arguments])
    assert isinstance(ran.exception, CalibrationError)
    assert words in str(ran.exception)
    assert "\n" not in str(ran.exception)
    assert list(tmp_path.iterdir()) == []
