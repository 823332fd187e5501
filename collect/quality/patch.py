"""A window of the paper as one photograph shows it, with the light taken out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.board.scale import Floats, apply
from calibrate.stroke.preprocess import PX_PER_MM, Gray, Mask, Params, Soft, flatten, rectify

Rect = tuple[float, float, float, float]
"""x, y, width, height in the paper frame, mm."""
Point = tuple[float, float]
GRAIN_MM = 0.15
"""Ink is looked for after smoothing over this: noise and paper fibres are finer."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A window at 20 px/mm, row 0 at its far edge."""

    window_mm: Rect
    raster: Gray
    """(h, w) as photographed; beyond the frame its border, repeated."""
    dark: Soft
    """(h, w) 0 = paper, 1 = reflects nothing; 0 beyond the frame."""
    in_view: Mask
    """(h, w) False where the photograph does not reach."""

    def to_px(self, point_mm: Point) -> Point:
        """(x, y) on the raster, pixel j covers [j, j + 1)."""
        x, y, _, height = self.window_mm
        return (point_mm[0] - x) * PX_PER_MM, (y + height - point_mm[1]) * PX_PER_MM

    def inside(self, rect_mm: Rect) -> tuple[slice, slice]:
        """Rows and columns of a rectangle, as far as the window has them."""
        left, bottom = self.to_px((rect_mm[0], rect_mm[1]))
        right, top = self.to_px((rect_mm[0] + rect_mm[2], rect_mm[1] + rect_mm[3]))
        return slice(max(round(top), 0), max(round(bottom), 0)), slice(max(round(left), 0), max(round(right), 0))

    def inked(self, gate: float) -> Mask:
        """(h, w) where there is ink, noise and grain smoothed away."""
        return np.asarray(cv2.GaussianBlur(self.dark, (0, 0), GRAIN_MM * PX_PER_MM), np.float32) > gate

    def points_mm(self, mask: Mask) -> Floats:
        """(n, 2) middles of a mask's pixels in the paper frame."""
        x, y, _, height = self.window_mm
        rows, columns = np.nonzero(mask)
        places = np.column_stack([x + (columns + 0.5) / PX_PER_MM, y + height - (rows + 0.5) / PX_PER_MM])
        return places.astype(np.float64)


def take(image: Gray, image_to_paper: Floats, window_mm: Rect, params: Params) -> Patch:
    """Rectify a window of an (h, w) photograph and divide it by its light. `image_to_paper` is (3, 3)."""
    raster = rectify(image, image_to_paper, window_mm)
    in_view = _in_view(image, image_to_paper, window_mm, raster)
    dark = np.where(in_view, 1.0 - flatten(raster, params), 0.0).astype(np.float32)
    return Patch(window_mm, raster, dark, in_view)


def around(rect_mm: Rect, margin_mm: float, sheet_mm: tuple[float, float] | None) -> Rect:
    """A rectangle with a margin, no farther than the sheet: the table beyond it is no paper."""
    left, bottom = rect_mm[0] - margin_mm, rect_mm[1] - margin_mm
    right, top = rect_mm[0] + rect_mm[2] + margin_mm, rect_mm[1] + rect_mm[3] + margin_mm
    if sheet_mm is not None:
        left, bottom = max(left, min(0.0, rect_mm[0])), max(bottom, min(0.0, rect_mm[1]))
        right = min(right, max(sheet_mm[0], rect_mm[0] + rect_mm[2]))
        top = min(top, max(sheet_mm[1], rect_mm[1] + rect_mm[3]))
    return left, bottom, right - left, top - bottom


def corners(rect_mm: Rect) -> Floats:
    """(4, 2) corners of a rectangle."""
    x, y, width, height = rect_mm
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def _in_view(image: Gray, image_to_paper: Floats, window_mm: Rect, raster: Gray) -> Mask:
    seen = apply(np.asarray(np.linalg.inv(image_to_paper), np.float64), corners(window_mm))
    if seen.min() >= 0.0 and bool((seen <= np.array(image.shape[::-1]) - 1.0).all()):
        return np.ones(raster.shape, np.bool_)
    # `rectify` repeats the frame's outermost pixels: make them tell that they are.
    shown = np.full(image.shape, 255, np.uint8)
    shown[[0, -1]] = 0
    shown[:, [0, -1]] = 0
    return rectify(shown, image_to_paper, window_mm) > 127
