"""Resampling of photographs to 20 px/mm: rectified and undistorted in one interpolation, or only rescaled."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np

from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke import PX_PER_MM, Floats, Gray

MAX_RASTER_PX = 8192
KNOTS = 8
"""Pixels between computed points of the distortion map; it changes slowly and is interpolated in between."""


def rectify(
    image: Gray, image_to_paper: Floats, window_mm: tuple[float, float, float, float], px_per_mm: float = PX_PER_MM
) -> Gray:
    """Rectify the window (x, y, width, height in the paper frame), row 0 at its far edge (largest y).

    `image_to_paper` has pixel centres on integers, as cv2 does; the result's pixel (i, j) covers [j, j+1) x [i, i+1).
    """
    x, y, width, height = window_mm
    step = 1.0 / px_per_mm
    raster_to_paper = np.array([[step, 0.0, x + 0.5 * step], [0.0, -step, y + height - 0.5 * step], [0.0, 0.0, 1.0]])
    raster_to_image = np.linalg.inv(image_to_paper) @ raster_to_paper
    size = (round(width * px_per_mm), round(height * px_per_mm))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image, raster_to_image, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cast("Gray", warped)


def rescale(image: Gray, px_per_mm: tuple[float, float], where: str) -> Gray:
    """Rescale a photograph of known scale to 20 px/mm. Raises `CaptureRefused` if the result is too small or large."""
    height, width = image.shape
    size = (round(width * PX_PER_MM / px_per_mm[0]), round(height * PX_PER_MM / px_per_mm[1]))
    if not all(8 <= side <= MAX_RASTER_PX for side in size):
        raise CaptureRefused(where, f"is {size[0]} x {size[1]} px at 20 px/mm, allowed 8 to {MAX_RASTER_PX}")
    shrinks = size[0] < width
    return cast("Gray", cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def cut_out(
    image: Gray,
    point_px: tuple[float, float],
    px_per_mm: tuple[float, float],
    reach_mm: tuple[float, float, float, float],
    where: str,
) -> tuple[Gray, tuple[float, float]]:
    """The part of a photograph that reaches so far from a point to the left, top, right and bottom; the point in it.

    Raises `CaptureRefused` for a point so far outside that nothing is left.
    """
    (x, y), (left, top, right, bottom) = point_px, reach_mm
    column, row = (max(0, math.floor(at - reach)) for at, reach in ((x, left * px_per_mm[0]), (y, top * px_per_mm[1])))
    last = max(0, math.ceil(y + bottom * px_per_mm[1])), max(0, math.ceil(x + right * px_per_mm[0]))
    part = image[row : last[0], column : last[1]]
    if not part.size:
        raise CaptureRefused(where, "anchor lies so far from the stroke that none of it is in the field")
    return part, (x - column, y - row)


def on_raster(point_px: tuple[float, float], px_per_mm: tuple[float, float]) -> tuple[float, float]:
    """Convert a point of a photograph to the raster that `rescale` returns."""
    return point_px[0] * PX_PER_MM / px_per_mm[0], point_px[1] * PX_PER_MM / px_per_mm[1]


def rectify_by(image: Gray, plane: Plane, window_mm: tuple[float, float, float, float], where: str) -> Gray:
    """Rectify the window (x, y, width, height in the paper frame) to 20 px/mm, as `rectify` does.

    The photograph is as it was taken; the lens distortion is removed here. Raises `CaptureRefused` if its size is not
    that of the photograph that the plane was seen in.
    """
    plane.lens.check_size(image, where)
    x, y, width, height = window_mm
    columns, rows = round(width * PX_PER_MM), round(height * PX_PER_MM)
    across, along = np.arange(0, columns + KNOTS, KNOTS), np.arange(0, rows + KNOTS, KNOTS)
    grid = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    paper_mm: Floats = np.array([x, y + height], np.float64) + np.array([1.0, -1.0]) * (grid + 0.5) / PX_PER_MM
    knots = plane.to_image(paper_mm).reshape(len(along), len(across), 2).astype(np.float32)
    # Knot k lies at pixel 8 k; cv2.resize would put it in the middle of its eight pixels.
    scale = np.array([[1.0 / KNOTS, 0.0, 0.0], [0.0, 1.0 / KNOTS, 0.0]])
    places = cv2.warpAffine(knots, scale, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    sampled = cv2.remap(image, places, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cast("Gray", sampled)


def on_window(
    cell_mm: tuple[float, float, float, float], window_mm: tuple[float, float, float, float]
) -> tuple[int, int, int, int]:
    """Convert a paper cell (x, y, width, height in mm) to pixels of a window's raster: x, y, width, height."""
    x, y, width, height = cell_mm
    top = window_mm[1] + window_mm[3] - (y + height)
    scaled = ((x - window_mm[0]) * PX_PER_MM, top * PX_PER_MM, width * PX_PER_MM, height * PX_PER_MM)
    return round(scaled[0]), round(scaled[1]), round(scaled[2]), round(scaled[3])
