"""Which photographs of the board are still missing before the lens is known."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from brushloop.calibrate.board.detect import BoardView
from brushloop.calibrate.board.intrinsics import GRID, distinct_views, guidance, held, nominal_normals
from brushloop.collect.teach.guide import Picture

WIDTH_PX = 320
SEEN, UNSEEN, CORNER = 90, 40, 255


def still_missing(views: Sequence[BoardView]) -> tuple[str, ...]:
    """Instructions for further photographs; empty where the views suffice. At least one view."""
    distinct, _ = distinct_views(views)
    normals = nominal_normals(distinct)
    slants_deg = np.degrees(np.arccos(np.clip(normals[:, 2], -1.0, 1.0))).tolist()
    return guidance(distinct, slants_deg, int(held(normals).max()) + 1)


def coverage_picture(views: Sequence[BoardView]) -> Picture:
    """A map of the camera's picture: corners seen so far as dots, and parts where none was seen darker."""
    width, height = views[0].size_px
    scale = WIDTH_PX / width
    rows_px = round(height * scale)
    picture = np.full((rows_px, WIDTH_PX), SEEN, np.uint8)
    places = np.concatenate([view.pixels for view in views]) * scale
    columns, rows = GRID
    for row in range(rows):
        for column in range(columns):
            left, right = WIDTH_PX * column // columns, WIDTH_PX * (column + 1) // columns
            top, bottom = rows_px * row // rows, rows_px * (row + 1) // rows
            x, y = places[:, 0], places[:, 1]
            if not ((x >= left) & (x < right) & (y >= top) & (y < bottom)).any():
                picture[top:bottom, left:right] = UNSEEN
    for x, y in places.tolist():
        cv2.circle(picture, (round(x), round(y)), 1, (CORNER,), -1)
    return picture
