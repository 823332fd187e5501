"""Scale, masks and anchors on the loopback rig's frozen brushes and cameras, held against the sheet itself."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import unknown_lens
from brushloop.calibrate.board.pix2len import Plane, fit_plane, paper_mm
from brushloop.calibrate.compare import field_around
from brushloop.calibrate.stroke import PX_PER_MM
from brushloop.calibrate.stroke.preprocess import prepare
from brushloop.calibrate.stroke.rectify import rectify_by
from tests.calibrate.simulated_rigs import (
    BRUSHES,
    CAMERAS,
    Shot,
    boards,
    sheet,
    true_mask,
    true_scale,
)

WORST = 2e-4
soak = pytest.mark.soak
half_an_hour = pytest.mark.timeout(1800)


def plane_of(shot: Shot) -> Plane:
    """The plane by a lens of which nothing is known."""
    view = find_board(shot.image, shot.board, "rig")
    return fit_plane(view.pixels, paper_mm(view, shot.board), unknown_lens(view.size_px), "rig")


def draws(rig: int, count: int, seed: int = 0) -> list[tuple[float, bool]]:
    """(relative error of pix2len, whether the interval holds the truth) for the camera aimed again each time."""
    aimed: list[tuple[float, bool]] = []
    for shot in boards(rig, count, seed):
        plane = plane_of(shot)
        truth = true_scale(shot, plane.middle_px)
        aimed.append((plane.mm_per_px / truth - 1.0, plane.mm_per_px_low <= truth <= plane.mm_per_px_high))
    return aimed


def strokes(rig: int, presses: int) -> tuple[list[float], float]:
    """IoU of every stroke's mask with the ink that is really there, and how far off the worst anchor is put, mm."""
    shot = sheet(rig, presses)
    plane = plane_of(shot)
    anchors = np.array(shot.anchors_mm)
    off_mm = np.linalg.norm(plane.to_paper(shot.optics.image_of(anchors)) - anchors, axis=1)
    return [overlap(shot, plane, anchor) for anchor in shot.anchors_mm], float(off_mm.max())


def overlap(shot: Shot, plane: Plane, anchor: tuple[float, float]) -> float:
    window = field_around(anchor)
    raster = rectify_by(shot.image, plane, window, "rig")
    at = ((anchor[0] - window[0]) * PX_PER_MM, (window[1] + window[3] - anchor[1]) * PX_PER_MM)
    mask = prepare(raster, at, "rig").mask
    truth = true_mask(shot, window, PX_PER_MM)
    return float((mask & truth).sum() / (mask | truth).sum())


@pytest.mark.parametrize("rig", [1, 2, 3], ids=["keystone", "shadow and pincushion", "barrel"])
def test_scale_strokes_and_anchors_are_right_whatever_the_camera_does(rig: int) -> None:
    [(error, _)] = draws(rig, 1)
    assert abs(error) <= WORST
    overlaps, off_mm = strokes(rig, 1)
    assert min(overlaps) >= 0.95
    assert off_mm <= 0.1


@soak
@half_an_hour
@pytest.mark.parametrize("seed", [0, 1])
def test_the_interval_of_pix2len_holds_the_truth_as_often_as_it_says(seed: int) -> None:
    every = [one for rig in range(len(CAMERAS)) for one in draws(rig, 40, seed)]
    assert max(abs(error) for error, _ in every) <= WORST
    assert 0.93 <= np.mean([held for _, held in every]) <= 0.97


@soak
@half_an_hour
def test_every_brush_under_every_camera() -> None:
    found = [strokes(rig, 15) for rig in range(len(BRUSHES))]
    every = [iou for overlaps, _ in found for iou in overlaps]
    assert max(off_mm for _, off_mm in found) <= 0.1
    assert np.mean(every) >= 0.985
    assert min(every) >= 0.95
