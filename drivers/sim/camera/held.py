"""A printed board that a person holds before the camera, for the calibration of its lens."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.rotation import columns as axes
from brushloop.drivers.rotation import of_vector
from brushloop.drivers.sim.camera.optics import Optics
from brushloop.drivers.sim.config import Table, View

PX_PER_MM = 6.0
EDGE_MM = 5.0
"""White edge of the print around the board."""
WHITE, BLACK, BEHIND = 245, 20, 110
FINGER_MM = 9.0
"""Radius of the thumb that covers a little of the print at either side."""


@dataclass(frozen=True, slots=True)
class Held:
    """How a board is held, in the camera's frame: x right, y down, z ahead."""

    turn_deg: tuple[float, float, float]
    """Rotation vector from the camera's axes to the board's; zero is face on and upright."""
    centre_mm: tuple[float, float, float]


def held_picture(
    board: cv2.aruco.CharucoBoard, table: Table, view: View, optics: Optics, held: Held
) -> NDArray[np.float32]:
    """(h, w) float32 gray levels of the board in hand, under the light of the table."""
    size_x_mm, size_y_mm = (n * table.board_square_mm for n in table.board_squares)
    inner = board.generateImage((round(size_x_mm * PX_PER_MM), round(size_y_mm * PX_PER_MM)))
    edge = round(EDGE_MM * PX_PER_MM)
    columns, rows = inner.shape[1] + 2 * edge, inner.shape[0] + 2 * edge
    paper = np.full((rows, columns), WHITE, np.uint8)
    paper[edge:-edge, edge:-edge] = np.where(np.asarray(inner) > 127, WHITE, BLACK)
    for column in (0, columns):
        cv2.circle(paper, (column, rows // 2), round(FINGER_MM * PX_PER_MM), (150,), -1)
    # raster pixel centres -> mm from the middle of the board -> image
    s = 1.0 / PX_PER_MM
    to_mm = np.array([[s, 0.0, -0.5 * s * (columns - 1)], [0.0, s, -0.5 * s * (rows - 1)], [0.0, 0.0, 1.0]])
    rx, ry, rz = (math.radians(turn_deg) for turn_deg in held.turn_deg)
    right, down, _ = axes(of_vector((rx, ry, rz)))
    plane = np.column_stack([right, down, held.centre_mm])
    flat = cv2.warpPerspective(
        paper, optics.camera_matrix @ plane @ to_mm, (view.width_px, view.height_px), borderValue=BEHIND
    )
    blurred = cv2.GaussianBlur(optics.distort(np.asarray(flat, np.uint8)), (0, 0), view.blur_px)
    return blurred.astype(np.float32) * optics.light
