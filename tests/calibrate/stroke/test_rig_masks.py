"""Masks and anchors on the loopback rig's frozen brushes and cameras, held against the sheet itself."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.view import see_board_and_lens
from brushloop.calibrate.stroke.params import PX_PER_MM, Params
from brushloop.calibrate.stroke.preprocess import prepare
from brushloop.calibrate.stroke.rectify import rectify_distorted
from tests.calibrate.simulated_rigs import BRUSHES, Shot, heading_free_window, sheet, true_mask


def overlaps(shot: Shot, plane: Plane) -> list[float]:
    """IoU of every stroke's mask with the ink that is really there."""
    found: list[float] = []
    for anchor in shot.anchors_mm:
        window = heading_free_window(anchor)
        raster = rectify_distorted(shot.image, plane, window)
        at = ((anchor[0] - window[0]) * PX_PER_MM, (window[1] + window[3] - anchor[1]) * PX_PER_MM)
        mask = prepare(raster, at, "rig", Params()).mask
        truth = true_mask(shot, window, PX_PER_MM)
        found.append(float((mask & truth).sum() / (mask | truth).sum()))
    return found


def anchor_error_mm(shot: Shot, plane: Plane) -> float:
    """How far off the worst anchor is put: through the true optics into the photograph, and back by ours."""
    anchors = np.array(shot.anchors_mm)
    back = plane.to_paper(shot.optics.image_of(anchors))
    return float(np.linalg.norm(back - anchors, axis=1).max())


@pytest.mark.parametrize("rig", [2, 3], ids=["shadow and pincushion", "barrel"])
def test_strokes_and_anchors_are_where_they_are(rig: int) -> None:
    shot = sheet(rig, 1)
    plane = see_board_and_lens(shot.image, shot.board)
    assert min(overlaps(shot, plane)) >= 0.95
    assert anchor_error_mm(shot, plane) <= 0.1


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_every_brush_under_every_camera() -> None:
    every: list[float] = []
    for rig in range(len(BRUSHES)):
        shot = sheet(rig, 15)
        plane = see_board_and_lens(shot.image, shot.board)
        found, anchor_mm = overlaps(shot, plane), anchor_error_mm(shot, plane)
        print(f"rig {rig}: IoU mean {np.mean(found):.4f}, worst {min(found):.4f}, anchor {anchor_mm:.4f} mm")  # noqa: T201
        assert anchor_mm <= 0.1
        every += found
    print(f"all: IoU mean {np.mean(every):.4f}, worst {min(every):.4f}")  # noqa: T201
    assert np.mean(every) >= 0.985
    assert min(every) >= 0.95
