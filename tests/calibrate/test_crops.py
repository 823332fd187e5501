"""`brushloop sessions export --crops`: strokes seen straight from above, at one scale, with masks."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.calibrated import CalibrateRequest, calibrate_session
from brushloop.calibrate.compare.place import Field
from brushloop.sessions.records import Stroke
from tests.calibrate.simulated_rigs import Shot, sheet, true_mask

if TYPE_CHECKING:
    from conftest import Photographed

STRAIGHT = 0
HOSTILE = "<b>mine</b>\n- `all`"


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def shot() -> Shot:
    return sheet(STRAIGHT, 2)


@pytest.fixture(scope="module")
def session(photographed: Photographed, tmp_path_factory: pytest.TempPathFactory, shot: Shot) -> Path:
    """A closed session of two presses, not calibrated."""
    strokes = [
        Stroke(stroke_id=f"s{k}", kind="press", still=0, depth_mm=13.0, tilt_deg=5.0, anchor_mm=anchor)
        for k, anchor in enumerate(shot.anchors_mm)
    ]
    folder = tmp_path_factory.mktemp("crops") / "pressed"
    return photographed(folder, shot.board, [shot.image], [(one, shot.image) for one in strokes])


@pytest.fixture(scope="module")
def exported(session: Path) -> Path:
    """The session calibrated and exported as PNG."""
    refused = run("sessions", "export", session, session.parent / "early", "--crops")
    assert f"is not calibrated: run `brushloop calibrate {session}`" in str(refused.exception)
    assert not (session.parent / "early").exists()
    calibrate_session(CalibrateRequest(session))
    out = session.parent / "exported"
    ran = run("sessions", "export", session, out, "--crops")
    assert ran.exit_code == 0, ran.output
    return out


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "strokes.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_crops_and_masks_lie_over_the_true_marks(exported: Path, shot: Shot) -> None:
    rows = rows_of(exported)
    assert [row["stroke_id"] for row in rows] == ["s0", "s1"]
    for row, anchor in zip(rows, shot.anchors_mm, strict=True):
        crop, mask = (cv2.imread(str(exported / row[name]), cv2.IMREAD_GRAYSCALE) for name in ("file", "mask_file"))
        assert crop.shape == mask.shape == (768, 768)
        assert (float(row["px_per_mm_x"]), float(row["px_per_mm_y"])) == (20.0, 20.0)
        left, top = (20.0 * v for v in Field().anchor_mm)
        assert (float(row["anchor_x_px"]), float(row["anchor_y_px"])) == pytest.approx((left, top))
        truth = true_mask(shot, Field().window_mm(anchor), 20.0)
        assert ((mask > 0) & truth).sum() / ((mask > 0) | truth).sum() >= 0.9
        assert crop[mask > 0].mean() < 0.5 * crop[mask == 0].mean()


def imported(folder: Path, *strokes: bool) -> Path:
    """A session imported from photographs at 10 px/mm: each with a stroke of 12 x 4 mm, or blank."""
    photographs = folder / "photographs"
    photographs.mkdir()
    lines = ["file,px_per_mm,depth_mm"]
    for number, is_inked in enumerate(strokes):
        image = np.full((300, 400), 225, np.uint8)
        if is_inked:
            cv2.ellipse(image, (200, 150), (60, 20), 0, 0, 360, 25, -1)
        cv2.imwrite(str(photographs / f"{number}.png"), image)
        lines.append(f"{number}.png,10,13")
    (photographs / "table.csv").write_text("\n".join(lines) + "\n")
    words = ("--csv", photographs / "table.csv", "--out", folder / "s", "--licence", HOSTILE)
    ran = run("sessions", "import", photographs, *words)
    assert ran.exit_code == 0, ran.output
    return folder / "s"


def test_imports_are_rescaled_and_what_cannot_be_cropped_is_named(tmp_path: Path) -> None:
    ran = run("sessions", "export", imported(tmp_path, True, False), tmp_path / "o", "--crops", "--format", "npz")
    assert ran.exit_code == 3
    assert "left out: 1: is blank" in ran.output
    with np.load(tmp_path / "o" / "strokes.npz") as strokes:
        assert strokes["mask_file"].tolist() == ["masks/0000-0.png"]
    mask = cv2.imread(str(tmp_path / "o" / "masks" / "0000-0.png"), cv2.IMREAD_GRAYSCALE)
    assert mask.shape == (600, 800)
    assert (mask > 0).sum() / 20.0**2 == pytest.approx(np.pi * 6 * 2, rel=0.05)


def test_a_session_without_any_crop_and_options_without_crops_are_refused(tmp_path: Path) -> None:
    session = imported(tmp_path, False)
    ran = run("sessions", "export", session, tmp_path / "o", "--crops")
    assert "holds no stroke that can be cropped: 0 is blank" in str(ran.exception)
    ran = run("sessions", "export", session, tmp_path / "o", "--calibration", "x.json")
    assert str(ran.exception) == "--calibration: needs --crops"
    assert not (tmp_path / "o").exists()
