"""Every stage of the preprocessing can be looked at, and says what is wrong with a capture that it can still use."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.calibrate.cli import app
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.stages import Trace, trace_scaled
from brushloop.calibrate.stroke.params import Params


def photograph(*strokes: tuple[int, int], glare: tuple[int, int] | None = None, paper: int = 225) -> np.ndarray:
    """Strokes of 12 x 4 mm at these places (px, 10 px/mm) on 80 x 60 mm."""
    image = np.full((600, 800), paper, np.float32)
    for place in strokes:
        cv2.ellipse(image, place, (60, 20), 0, 0, 360, 25, -1)
    image = cv2.GaussianBlur(image, (0, 0), 1.0) + np.random.default_rng(0).normal(0, 1.5, image.shape)
    if glare is not None:
        ys, xs = np.ogrid[:600, :800]
        image += 120 * np.exp(-((xs - glare[0]) ** 2 + (ys - glare[1]) ** 2) / 2 / 25**2)
    return np.clip(image, 0, 255).astype(np.uint8)


def trace(image: np.ndarray, anchor: tuple[float, float] | None = None, params: Params | None = None):
    return trace_scaled(image, (10.0, 10.0), anchor, "photograph", params or Params())


def inked(found: Trace) -> np.ndarray:
    """The last stage, (128, 128), True where ink."""
    return found.stages[-1].image == 0


def test_a_stroke_comes_out_at_the_scale_of_the_validation_with_its_anchor() -> None:
    found = trace(photograph((400, 300)), (430.0, 310.0))
    assert inked(found).shape == (128, 128)
    assert found.log["resize.mm_per_px"] == Field().mm_per_px
    assert found.log["resize.area_mm2"] == pytest.approx(np.pi * 6 * 2, rel=0.05)
    left, top = (v / MM_PER_PX for v in Field().anchor_mm)
    assert found.log["crop.anchor_x_px"] == pytest.approx(20.0 * MM_PER_PX * left, abs=0.6)
    rows, columns = np.nonzero(inked(found))
    assert (columns.mean(), rows.mean()) == pytest.approx((left - 3.0 / MM_PER_PX, top - 1.0 / MM_PER_PX), abs=1.0)
    assert found.log["components.others"] == 0
    assert found.flags == ()


LONG = cv2.line(photograph(), (100, 300), (700, 300), 25, 30)
EIGHT = [(150 + 165 * (k % 4), 150 + 250 * (k // 4)) for k in range(8)]


@pytest.mark.parametrize(
    ("image", "flag"),
    [
        (photograph(*EIGHT), "others: 7 more strokes"),
        (photograph((400, 300), paper=300), "saturated"),
        (photograph((400, 300), glare=(400, 318), paper=170), "glare"),
        (photograph((790, 300)), "cut"),
        (LONG, "too long"),
    ],
    ids=["neighbours", "too bright", "glare", "at the edge", "long"],
)
def test_a_defect_is_flagged(image: np.ndarray, flag: str) -> None:
    assert any(one.startswith(flag) for one in trace(image).flags)


def test_holes_of_glare_are_filled_where_that_is_asked_for() -> None:
    image = photograph((400, 300))
    cv2.circle(image, (400, 300), 5, 225, -1)
    kept, filled = trace(image), trace(image, params=Params(hole_mm2=1.0))
    area = [found.log["resize.area_mm2"] for found in (kept, filled)]
    assert area[1] - area[0] == pytest.approx(np.pi * 0.25, abs=4 * MM_PER_PX**2)


def test_the_command_shows_every_stage_and_writes_the_numbers(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), photograph((200, 150)))
    cv2.imwrite(str(tmp_path / "b.png"), photograph((200, 150), (500, 400)))
    out = tmp_path / "stages.png"
    arguments = ["preprocess", str(tmp_path / "b.png"), "--px-per-mm", "10", "--out", str(out)]
    ran = CliRunner().invoke(app, [*arguments, "--before", str(tmp_path / "a.png")])
    assert ran.exit_code == 0, ran.output
    assert cv2.imread(str(out), 0).shape[1] > 1000
    numbers = json.loads(out.with_suffix(".json").read_text())
    assert numbers["fitted"]["components.others"] == 0
    assert numbers["params"]["join_mm"] == 1.5
    CliRunner().invoke(app, arguments)
    assert json.loads(out.with_suffix(".json").read_text())["fitted"]["components.others"] == 1


def test_the_command_still_takes_a_session_as_it_did(tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, [str(tmp_path / "nosuch")])
    assert "no such session" in str(ran.exception)
    assert CliRunner().invoke(app, []).exit_code == 2
