"""Straighten and rectify in one step: the photograph is interpolated once, not twice."""

from __future__ import annotations

from typing import Protocol, cast

import cv2
import numpy as np

from calibrate.board.lens import Floats, Gray
from calibrate.calibration import Calibration
from calibrate.errors import CaptureRefused
from calibrate.stroke.preprocess import PX_PER_MM, rectify

KNOTS = 8
"""The lens bends so little that its map is worked out at every eighth pixel and interpolated."""


class SeenPlane(Protocol):
    """A plane of paper that a photograph shows."""

    def to_image(self, paper_mm: Floats) -> Floats:
        """(n, 2) mm in the paper frame -> (n, 2) pixels of the photograph as it was taken."""
        ...


def rectify_by(image: Gray, calibration: Calibration, window_mm: tuple[float, float, float, float], where: str) -> Gray:
    """The window of the paper frame at 20 px/mm, by a calibration: straightened where it names a lens.

    Raises `CaptureRefused` for a photograph of another size than the calibration's.
    """
    if calibration.lens is None:
        return rectify(image, calibration.homography(), window_mm)
    height, width = image.shape
    if (width, height) != calibration.lens.size_px:
        wanted = "{} x {}".format(*calibration.lens.size_px)
        raise CaptureRefused(where, f"is {width} x {height} px, the calibration is for {wanted} px")
    return rectify_distorted(image, calibration, window_mm)


def rectify_distorted(image: Gray, plane: SeenPlane, window_mm: tuple[float, float, float, float]) -> Gray:
    """The window (x, y, width, height in the paper frame) at 20 px/mm, as `preprocess.rectify` gives it.

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
