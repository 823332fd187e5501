"""Imported photographs, from the command line to the report: a made-up folder, and the real ones where they are."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.command import brushloop

DATA = Path(__file__).parents[3] / "shared" / "data"
real = pytest.mark.skipif(not DATA.is_dir(), reason="the folders of real photographs are not here")


def photographs(folder: Path) -> Path:
    """Eight drags whose width is 3 mm + 0.5 mm per mm of depth, at 8 px/mm."""
    folder.mkdir()
    rows = ["file,length_mm,depth_mm,px_per_mm"]
    for k in range(8):
        depth, length = 2.0 * k, 20.0 + 2.0 * k
        image = np.full((320, 480), 240, np.uint8)
        half = round((3.0 + 0.5 * depth) * 8 / 2)
        cv2.rectangle(image, (80, 160 - half), (80 + round(length * 8), 160 + half), 25, -1)
        cv2.imwrite(str(folder / f"{k}.png"), image)
        rows.append(f"{k}.png,{length},{depth},8.0")
    (folder / "strokes.csv").write_text("\n".join(rows) + "\n")
    return folder


def measured(session: Path) -> list[dict[str, str]]:
    with (session / "validation" / "measured.csv").open() as file:
        return list(csv.DictReader(file))


def test_width_is_fitted_against_depth_in_a_report_that_fetches_nothing(tmp_path: Path) -> None:
    folder, hostile = photographs(tmp_path / "photos"), "<script>alert(1)</script>"
    words = ("--csv", folder / "strokes.csv", "--kind", "drag", "--licence", hostile, "--origin", hostile)
    assert brushloop("sessions", "import", folder, *words, cwd=tmp_path).returncode == 0
    ran = brushloop("validate", "sessions/photos", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    slope = re.search(r"depth: (\d\.\d+) mm/mm .*?, \+(\d\.\d+) mm at", " ".join(ran.stdout.split()))
    assert slope is not None
    assert float(slope[1]) == pytest.approx(0.5, abs=0.02)
    assert float(slope[2]) == pytest.approx(3.0, abs=0.2)
    for row in measured(tmp_path / "sessions" / "photos"):
        assert float(row["measured_length_mm"]) == pytest.approx(float(row["commanded_length_mm"]), abs=0.3)
    page = (tmp_path / "sessions" / "photos" / "validation" / "report.html").read_text()
    assert "imported photographs" in page
    assert "cannot be compared with these strokes" in page
    assert hostile not in page
    assert "&lt;script&gt;" in page
    assert re.findall(r'(?:src|href)="(?!data:image/(?:png|svg\+xml);base64,)', page) == []
    assert "<script" not in page


@real
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
    rows = measured(tmp_path / "sessions" / name)
    assert len(rows) == strokes
    for command, correlation in least.items():
        size = {"length_mm": "measured_length_mm"}.get(command, "measured_mid_width_mm")
        pairs = np.array([(float(row[f"commanded_{command}"]), float(row[size])) for row in rows])
        assert np.corrcoef(pairs.T)[0, 1] > correlation
