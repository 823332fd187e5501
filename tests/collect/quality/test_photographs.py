"""Real photographs, where they are: what their ink is called. They are drags, and nothing was tuned to them."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.brushes import DATA as SHARED
from brushloop.collect.photograph.checks import Failure, Verdict, check_capture
from brushloop.collect.rig.config import QualityConfig
from brushloop.collect.rig.paper import Patch
from tests.calibrate.given import flat_plane

DATA = SHARED / "frida_bigbrush_tilt_16x20"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the folder of real photographs is not here")
WHITENED = QualityConfig(bright_level=256.0, glare_mm2=1e6)
"""For paper that whoever published it has set to 255: neither exposure nor glare can be judged."""
INK = (Failure.NEIGHBOUR, Failure.BLANK, Failure.DRY, Failure.FAINT)
"""What can be asked of a drag: its place and its shape are not those of a press."""
DEPTH_MM = 9.0
"""For rows of the table without a depth."""


def rows(folder: Path) -> list[dict[str, str]]:
    """The table of a folder."""
    with (folder / "strokes.csv").open() as file:
        return list(csv.DictReader(file))


def judge(folder: Path, row: dict[str, str], limits: QualityConfig) -> Verdict:
    """The verdict on one photograph as a whole, as if it were a patch."""
    image = cv2.imread(str(folder / row["file"]), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    x_mm, y_mm = 1.0 / float(row["px_per_mm_x"]), 1.0 / float(row["px_per_mm_y"])
    size_x_mm, size_y_mm = image.shape[1] * x_mm, image.shape[0] * y_mm
    return check_capture(
        image.astype(np.uint8),
        flat_plane((image.shape[1], image.shape[0]), (x_mm, y_mm)),
        Patch(0, 0.0, 0.0, size_x_mm, size_y_mm),
        depth_mm=max(float(row.get("depth_mid_mm_nominal") or DEPTH_MM), 1.0),
        limits=limits,
        sheet_mm=(size_x_mm, size_y_mm),
        anchor_mm=(float(row["start_x_px"]) * x_mm, size_y_mm - float(row["start_y_px"]) * y_mm),
    )


def named(verdict: Verdict, among: Sequence[Failure] = tuple(Failure)) -> str:
    """The first failure among those asked for, in a word."""
    failed = [check.name for check in verdict.checks if not check.passed and check.name in among]
    return str(failed[0]) if failed else "sound"


def test_the_blank_photograph_is_called_blank() -> None:
    [blank] = [row for row in rows(DATA) if row["file"] == "png/120.png"]
    assert named(judge(DATA, blank, WHITENED)) == "blank"


def test_the_ink_of_most_strokes_is_called_sound_and_none_blank() -> None:
    inked = [row for row in rows(DATA)[::12] if row["file"] != "png/120.png"]
    called = Counter(named(judge(DATA, row, WHITENED), INK) for row in inked)
    assert called["blank"] == 0
    assert called["sound"] > 0.5 * called.total(), called


def test_a_whitened_photograph_is_refused_as_overexposed_unless_the_limit_is_lifted() -> None:
    assert named(judge(DATA, rows(DATA)[0], QualityConfig())) == "exposure"
