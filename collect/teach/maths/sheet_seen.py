"""Where the camera sees the sheet end on its board, compared with where its corners were touched."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.detect import BoardView
from brushloop.calibrate.board.pix2len import apply, homography
from brushloop.calibrate.board.spec import BoardSpec, size_mm
from brushloop.calibrate.board.view import paper_mm
from brushloop.collect.errors import CannotTeach
from brushloop.collect.rig.optics import Gray

Floats = NDArray[np.float64]
STEP_MM = 0.25
MIDDLE = 0.5
"""Share of the sheet's width or height over which an edge is looked for: corners may be bent."""
LEAST_CONTRAST = 12.0
"""Least difference in gray levels between the board's pattern and the plain sheet, as standard deviations along it."""
TIMES_PLAIN = 2.5
"""Least ratio of the two: a board without a sheet must not pass for plain paper."""
OFF_MM = 2.5
"""A touched edge that the camera sees farther off than this is doubted: hand and camera together err by 1 mm."""
SIDES = ("left", "right", "lower", "upper")


@dataclass(frozen=True, slots=True)
class Margins:
    """How much of the board is free beside the sheet on each side, in mm."""

    left: float
    right: float
    lower: float
    upper: float

    def off_mm(self, left: float, right: float, lower: float, upper: float) -> float:
        """Largest difference from these margins."""
        mine = (self.left, self.right, self.lower, self.upper)
        return max(abs(a - b) for a, b in zip(mine, (left, right, lower, upper), strict=True))


def touched_margins(board_origin_mm: tuple[float, float], sheet_mm: tuple[float, float], spec: BoardSpec) -> Margins:
    """From the board's lower left corner in the sheet's frame, and the sheet's size."""
    (x, y), (width, height), (board_width, board_height) = board_origin_mm, sheet_mm, size_mm(spec)
    return Margins(-x, board_width + x - width, -y, board_height + y - height)


def seen_margins(image: Gray, view: BoardView, spec: BoardSpec, touched: Margins) -> Margins | None:
    """Where the board's pattern ends on each side, looking outward from the middle of the touched sheet.

    `image` is an undistorted photograph, `view` its board, whose spec has its origin at (0, 0). None where an edge is
    not seen.
    """
    width, height = size_mm(spec)
    to_pixels = homography(paper_mm(view, spec), view.pixels, "camera")
    middle = np.array([touched.left + width - touched.right, touched.lower + height - touched.upper]) / 2.0
    half = MIDDLE * np.array([width - touched.left - touched.right, height - touched.lower - touched.upper]) / 2.0
    found: list[float] = []
    ways = ((0, -1, middle[0]), (0, 1, width - middle[0]), (1, -1, middle[1]), (1, 1, height - middle[1]))
    for axis, outward, room in ways:
        out_mm = np.arange(0.0, room, STEP_MM)
        beside_mm = np.arange(-half[1 - axis], half[1 - axis], STEP_MM)
        points = np.empty((len(out_mm), len(beside_mm), 2))
        points[..., axis] = middle[axis] + outward * out_mm[:, None]
        points[..., 1 - axis] = middle[1 - axis] + beside_mm
        at = apply(to_pixels, points.reshape(-1, 2)).reshape(points.shape).astype(np.float32)
        gray = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        edge_mm = _edge(np.asarray(gray, np.float64).std(axis=1), out_mm)
        if edge_mm is None:
            return None
        found.append(float(room) - edge_mm)
    return Margins(*found)


def _edge(spread: Floats, out_mm: Floats) -> float | None:
    """Where the spread along the edge rises from that of plain paper to that of the pattern."""
    plain, pattern = float(np.median(spread[: len(spread) // 3])), float(np.quantile(spread, 0.95))
    if pattern - plain < LEAST_CONTRAST or pattern < TIMES_PLAIN * plain:
        return None
    first = int(np.argmax(spread > (plain + pattern) / 2.0))
    return float(out_mm[first])


def check_seen(seen: Margins, touched: Margins) -> float:
    """How far the touched edges are from the seen ones at worst, in mm.

    Raises `CannotTeach` where that is more than `OFF_MM`, and says whether sides were taken for one another.
    """
    off_mm = seen.off_mm(touched.left, touched.right, touched.lower, touched.upper)
    if off_mm <= OFF_MM:
        return off_mm
    again = "Touch the corners of board and sheet again; lower left is the corner beside the beginning of its name."
    left, right, lower, upper = touched.left, touched.right, touched.lower, touched.upper
    for taken, what in (
        ((right, left, upper, lower), "the corners were named turned by half a turn: upper for lower, right for left"),
        ((right, left, lower, upper), "left and right corners were taken for one another, as in a mirror"),
        ((left, right, upper, lower), "lower and upper corners were taken for one another, as in a mirror"),
    ):
        if seen.off_mm(*taken) <= OFF_MM:
            raise CannotTeach(f"the camera sees the sheet elsewhere on its board: {what}.", again)
    listed = ", ".join(f"{side} {getattr(seen, side):.1f} mm ({getattr(touched, side):.1f} touched)" for side in SIDES)
    raise CannotTeach(
        f"the camera sees other margins of the board beside the sheet than were touched: {listed}.",
        "Sheet or board has moved, or a corner was touched beside the sheet: touch all corners again.",
    )
