"""Straighten and rectify in one step: the photograph is interpolated once, not twice."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np

from calibrate.camera.lens import Floats, Gray
from calibrate.camera.plane import Plane
from calibrate.preprocess import PX_PER_MM

KNOTS = 8
"""The lens bends so little that its map is worked out at every eighth pixel and interpolated."""


def rectify_bent(image: Gray, plane: Plane, window_mm: tuple[float, float, float, float]) -> Gray:
    """The window (x, y, width, height in the paper frame) at 20 px/mm, as `calibrate.preprocess.rectify` gives it.

    The photograph is as it was taken: what the lens bends is undone here.
    """
    x, y, width, height = window_mm
    columns, rows = round(width * PX_PER_MM), round(height * PX_PER_MM)
    across, along = np.arange(0, columns + KNOTS, KNOTS), np.arange(0, rows + KNOTS, KNOTS)
    grid = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    paper_mm: Floats = np.array([x, y + height], np.float64) + np.array([1.0, -1.0]) * (grid + 0.5) / PX_PER_MM
    knots = plane.to_image(paper_mm).reshape(len(along), len(across), 2).astype(np.float32)
    # Knot k lies at pixel 8 k: cv2's resize would put it at the middle of its eight.
    scale = np.array([[1.0 / KNOTS, 0.0, 0.0], [0.0, 1.0 / KNOTS, 0.0]])
    places = cv2.warpAffine(knots, scale, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    sampled = cv2.remap(image, places, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cast("Gray", sampled)
