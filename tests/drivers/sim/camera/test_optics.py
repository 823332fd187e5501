"""The loopback camera's optics are known exactly, so that a calibration can be held against them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from brushloop.drivers.sim.camera.scene import Optics, Scene, board
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.world import World

BENT = View(k1=-0.08)


def test_a_perfect_lens_is_the_homography_alone() -> None:
    optics = Optics(View(), 1)
    points = np.array([[0.0, 0.0], [122.0, 86.0], [244.0, 172.0]])
    mapped = np.column_stack([points, np.ones(3)]) @ optics.homography.T
    assert optics.image_of(points) == pytest.approx(mapped[:, :2] / mapped[:, 2:], abs=1e-9)


def test_distortion_leaves_the_middle_and_pulls_the_corners_in() -> None:
    undistorted, distorted = Optics(replace(BENT, k1=0.0), 1), Optics(BENT, 1)
    points = np.array([[122.0, 86.0], [0.0, 0.0]])
    moved = np.linalg.norm(distorted.image_of(points) - undistorted.image_of(points), axis=1)
    assert moved[0] < 0.05
    assert 3.0 < moved[1] < 40.0


def test_corners_of_the_rendered_board_lie_where_the_optics_say() -> None:
    config = SimConfig(view=BENT)
    scene = Scene(World(config))
    detector = cv2.aruco.CharucoDetector(board(config.table))
    corners, ids, _, _ = detector.detectBoard(scene.render())
    on_board = np.asarray(board(config.table).getChessboardCorners())[ids.ravel(), :2]
    table = config.table
    paper = np.column_stack(
        [
            table.board_origin_mm[0] + on_board[:, 0],
            table.board_origin_mm[1] + table.board_squares[1] * table.board_square_mm - on_board[:, 1],
        ]
    )
    off = np.linalg.norm(corners.reshape(-1, 2) - scene.optics.image_of(paper.astype(np.float64)), axis=1)
    assert len(ids) > 100
    assert np.median(off) < 0.3
    assert np.quantile(off, 0.95) < 0.8


def test_a_shadow_takes_light_from_a_part_of_the_sheet_only() -> None:
    lit, shaded = Optics(View(), 1).light, Optics(View(shadow=0.4), 1).light
    ratio = shaded / lit
    assert ratio.min() == pytest.approx(0.6, abs=0.01)
    assert ratio.max() == pytest.approx(1.0, abs=0.01)
    assert 0.2 < float((ratio < 0.8).mean()) < 0.8


def test_the_seed_moves_the_shadow() -> None:
    view = View(shadow=0.4)
    assert np.array_equal(Optics(view, 1).light, Optics(view, 1).light)
    assert not np.array_equal(Optics(view, 1).light, Optics(view, 2).light)
