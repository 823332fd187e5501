"""Strokes with a defect, from photographs to the report: named, counted less, and listed."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.drags.captures import read_drags
from brushloop.calibrate.drags.measure import FLAGGED_WEIGHT, validate_drags
from brushloop.calibrate.drags.report import DragValidation, summary, write_drags
from brushloop.calibrate.stroke.params import Params
from brushloop.sessions.imports import ImportOptions, import_photographs
from brushloop.sessions.recording import Recording

PX = 10
LEFT, TOP = 200, 250


def page(*defects: str) -> np.ndarray:
    """A stroke of 40 x 5 mm on gray paper, 10 px/mm."""
    image = np.full((500, 800), 185, np.uint8)
    cv2.rectangle(image, (LEFT, TOP - 25), (LEFT + 400, TOP + 25), 30, -1)
    if "torn" in defects:
        image[:, LEFT + 150 : LEFT + 190] = 185
    if "hollow" in defects:
        image[TOP - 17 : TOP + 17, LEFT + 8 : LEFT + 392] = 185
    if "glare" in defects:
        cv2.circle(image, (LEFT + 100, 80), 30, 253, -1)
    if "cut" in defects:
        image[:, LEFT + 370 : LEFT + 390] = 185
        image[TOP - 25 : TOP + 25, LEFT + 390 :] = 30
    return image


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    lines = ["file,length_mm,depth_mm,px_per_mm,start_x_px,start_y_px"]
    for k, name in enumerate(("whole", "torn", "hollow", "glare", "cut")):
        cv2.imwrite(str(folder / f"{name}.png"), page(name))
        lines.append(f"{name}.png,40,{3 + k},{PX},{LEFT},{TOP}")
    (folder / "strokes.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path_factory.mktemp("sessions") / "drags"
    import_photographs(folder, folder / "strokes.csv", out, ImportOptions(kind="drag"), "test", lambda: 1)
    return out


def test_flagged_strokes_count_less_and_a_cut_one_not_at_all(session: Path) -> None:
    drawn = read_drags(session, 1.0)
    weights = dict(zip(drawn.stroke_ids, drawn.weights.tolist(), strict=True))
    assert weights == {"whole": 1.0, "torn": FLAGGED_WEIGHT, "hollow": FLAGGED_WEIGHT, "glare": FLAGGED_WEIGHT}
    assert [name for name, _ in drawn.refused] == ["cut"]
    assert {
        name: flags[0].split(":")[0] for name, flags in zip(drawn.stroke_ids, drawn.flags, strict=True) if flags
    } == {name: name for name in ("torn", "hollow", "glare")}


def test_the_report_lists_them(session: Path, tmp_path: Path) -> None:
    recording = Recording(session)
    results = validate_drags(recording.captures(), Params())
    validation = DragValidation(recording.header, recording.path, "", results)
    html = write_drags(validation, tmp_path, "test").read_text()
    said = "\n".join(line for line in summary(validation) if isinstance(line, str))
    for words in ("torn: torn: 2 parts", "hollow: hollow: ink covers", "glare: glare:"):
        assert words in html
        assert f"counts less: {words}" in said
    with (tmp_path / "measured.csv").open() as file:
        rows = {row["stroke_id"]: row for row in csv.DictReader(file)}
    assert rows["torn"]["flags"].startswith("torn: 2 parts")
    assert [name for name, row in rows.items() if row["cut"] == "1"] == ["cut"]
    assert rows["whole"]["source"] == "imported photographs"
    assert {drag.stroke_id: drag.weight for drag in results.strokes}["torn"] == FLAGGED_WEIGHT
