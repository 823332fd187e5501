"""The ink in a window of the paper: the press's own, what was there before, and what fell beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from brushloop.calibrate.board.lens import Floats, apply
from brushloop.calibrate.stroke import PX_PER_MM, Gray, Mask, Params, Soft
from brushloop.calibrate.stroke.preprocess import flatten
from brushloop.calibrate.stroke.rectify import rectify

Rect = tuple[float, float, float, float]
"""x, y, width, height in the paper frame, mm."""
Point = tuple[float, float]
EDGE_MM = 1.5
"""Margin inside the sheet's edge that is not judged: origin and size of a sheet are known to tenths of a millimetre, so
what is seen there may be the board or the table beneath."""
GRAIN_MM = 0.15
"""Scale of the smoothing before ink is looked for: noise and paper fibres are finer."""


@dataclass(frozen=True, slots=True)
class Window:
    """A window at 20 px/mm, row 0 at its far edge."""

    window_mm: Rect
    raster: Gray
    """(h, w) as photographed; beyond the frame, its border is repeated."""
    dark: Soft
    """(h, w) 0 = paper, 1 = reflects nothing; 0 beyond the frame."""
    in_view: Mask
    """(h, w) False where the photograph does not reach."""
    pixel_mm: float
    """Side of a pixel of the photograph, on the paper."""

    def to_px(self, point_mm: Point) -> Point:
        """(x, y) on the raster, where pixel j covers [j, j + 1)."""
        x, y, _, height = self.window_mm
        return (point_mm[0] - x) * PX_PER_MM, (y + height - point_mm[1]) * PX_PER_MM

    def inside(self, rect_mm: Rect) -> tuple[slice, slice]:
        """Rows and columns of a rectangle, clipped to the window."""
        left, bottom = self.to_px((rect_mm[0], rect_mm[1]))
        right, top = self.to_px((rect_mm[0] + rect_mm[2], rect_mm[1] + rect_mm[3]))
        return slice(max(round(top), 0), max(round(bottom), 0)), slice(max(round(left), 0), max(round(right), 0))

    def inked(self, gate: float) -> Mask:
        """(h, w) True where there is ink, after noise and grain are smoothed away."""
        return np.asarray(cv2.GaussianBlur(self.dark, (0, 0), GRAIN_MM * PX_PER_MM), np.float32) > gate

    def points_mm(self, mask: Mask) -> Floats:
        """(n, 2) centres of a mask's pixels in the paper frame."""
        x, y, _, height = self.window_mm
        rows, columns = np.nonzero(mask)
        places = np.column_stack([x + (columns + 0.5) / PX_PER_MM, y + height - (rows + 0.5) / PX_PER_MM])
        return places.astype(np.float64)


def take(image: Gray, image_to_paper: Floats, window_mm: Rect, params: Params) -> Window:
    """Rectify a window of an (h, w) photograph and divide it by its illumination. `image_to_paper` is (3, 3)."""
    raster = rectify(image, image_to_paper, window_mm)
    in_view = _in_view(image, image_to_paper, window_mm, raster)
    dark = np.where(in_view, 1.0 - flatten(raster, params), 0.0).astype(np.float32)
    seen = apply(np.asarray(np.linalg.inv(image_to_paper), np.float64), corners(window_mm))
    pixel_mm = math.sqrt(window_mm[2] * window_mm[3] / cv2.contourArea(seen.astype(np.float32)))
    return Window(window_mm, raster, dark, in_view, pixel_mm)


def on_sheet(rect_mm: Rect, sheet_mm: tuple[float, float] | None) -> Rect:
    """The part of a rectangle that is surely paper: farther than `EDGE_MM` from the edges of the sheet."""
    if sheet_mm is None:
        return rect_mm
    left, bottom = max(rect_mm[0], EDGE_MM), max(rect_mm[1], EDGE_MM)
    right = min(rect_mm[0] + rect_mm[2], sheet_mm[0] - EDGE_MM)
    top = min(rect_mm[1] + rect_mm[3], sheet_mm[1] - EDGE_MM)
    return left, bottom, right - left, top - bottom


def around(rect_mm: Rect, margin_mm: float, sheet_mm: tuple[float, float] | None) -> Rect:
    """A rectangle with a margin, clipped to the sheet: the table beyond it is not paper."""
    x, y, width, height = rect_mm
    return on_sheet((x - margin_mm, y - margin_mm, width + 2.0 * margin_mm, height + 2.0 * margin_mm), sheet_mm)


def corners(rect_mm: Rect) -> Floats:
    """(4, 2) corners of a rectangle."""
    x, y, width, height = rect_mm
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def _in_view(image: Gray, image_to_paper: Floats, window_mm: Rect, raster: Gray) -> Mask:
    seen = apply(np.asarray(np.linalg.inv(image_to_paper), np.float64), corners(window_mm))
    if seen.min() >= 0.0 and bool((seen <= np.array(image.shape[::-1]) - 1.0).all()):
        return np.ones(raster.shape, np.bool_)
    # `rectify` repeats the frame's outermost pixels: mark them, to see where it did.
    shown = np.full(image.shape, 255, np.uint8)
    shown[[0, -1]] = 0
    shown[:, [0, -1]] = 0
    return rectify(shown, image_to_paper, window_mm) > 127


COARSE = 4
"""Parts of a stroke are joined on a raster this many times coarser."""
JOIN_MM = 2.5
"""Spots of ink closer than this belong together: hairs of a dry brush, the halves of a split tuft."""
NEAR_MM = 3.0
"""Ink this close to the zero-touch point is taken for the stroke, unless it is small compared with another piece."""
NEAR_SHARE = 0.2
HOME_SHARE = 0.3
SMALLEST_MM2 = 0.2
"""Spots below this are specks of the paper."""
SEAM_MM = 0.3
"""Old ink is grown by this: an edge never falls on exactly the same pixel twice."""


@dataclass(frozen=True, slots=True)
class Ink:
    """The ink of a press, distinguished from everything else in its window."""

    window: Window
    own: Mask
    """(h, w) the press's own ink, every spot of it above the gate."""
    before_mm2: float
    """Ink in the patch from before the press; 0 without a photograph from before."""
    beside_mm2: float
    """Other ink in the patch that lies apart from the press's own."""

    @property
    def own_mm2(self) -> float:
        """Area of the press's own ink."""
        return mm2(self.own)


def tell_apart(now: Window, before: Window | None, cell_mm: Rect, anchor_mm: Point, gate: float) -> Ink:
    """Find the press's own ink: new since `before` if that is given, in one piece, and near the anchor."""
    ink = now.inked(gate)
    patch = now.inside(cell_mm)
    before_mm2 = 0.0
    if before is not None:
        old = before.inked(gate)
        before_mm2 = mm2(old[patch])
        side = round(SEAM_MM * PX_PER_MM) | 1
        ink &= cv2.dilate(old.astype(np.uint8), np.ones((side, side), np.uint8)) == 0
    # Without a photograph from before, a piece that lies mostly in the next patch is taken to belong there.
    least_share = HOME_SHARE if before is None else 0.0
    own, beside_mm2 = _own_piece(ink, now.to_px(anchor_mm), patch, least_share)
    return Ink(now, own, before_mm2, beside_mm2)


def mm2(mask: Mask) -> float:
    """Area of a mask at 20 px/mm."""
    return float(np.count_nonzero(mask)) / PX_PER_MM**2


def _own_piece(ink: Mask, anchor_px: Point, patch: tuple[slice, slice], least_share: float) -> tuple[Mask, float]:
    """(the stroke's piece, at least `least_share` of which lies in the patch; mm^2 of the other pieces in it)."""
    height, width = ink.shape
    pieces, count = _pieces(ink)
    areas = np.bincount(pieces.ravel(), minlength=count) / PX_PER_MM**2
    in_cell = np.bincount(pieces[patch].ravel(), minlength=count) / PX_PER_MM**2
    in_cell[0] = areas[0] = 0.0
    at_home = np.where(in_cell >= least_share * areas, areas, 0.0)
    if count <= 1 or at_home.max() == 0.0:
        return np.zeros_like(ink), float(in_cell[in_cell >= SMALLEST_MM2].sum())
    rows, columns = np.ogrid[:height, :width]
    near = (columns + 0.5 - anchor_px[0]) ** 2 + (rows + 0.5 - anchor_px[1]) ** 2 <= (NEAR_MM * PX_PER_MM) ** 2
    touches = np.bincount(pieces[near], minlength=count) > 0
    candidates = np.flatnonzero(touches & (at_home > 0.0) & (at_home >= NEAR_SHARE * at_home.max()))
    main = int(candidates[np.argmax(at_home[candidates])]) if candidates.size else int(np.argmax(at_home))
    in_cell[main] = 0.0
    return pieces == main, float(in_cell[in_cell >= SMALLEST_MM2].sum())


def _pieces(ink: Mask) -> tuple[np.ndarray[tuple[int, int], np.dtype[np.int32]], int]:
    """(h, w) number of the piece that each inked pixel belongs to, 0 = paper, and how many numbers there are."""
    height, width = ink.shape
    small = (max(width // COARSE, 1), max(height // COARSE, 1))
    share = cv2.resize(ink.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    side = round(JOIN_MM * PX_PER_MM / COARSE) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    joined = cv2.morphologyEx(np.pad((share > 0.0).astype(np.uint8), side), cv2.MORPH_CLOSE, kernel)
    count, labels = cv2.connectedComponents(np.ascontiguousarray(joined[side:-side, side:-side]), connectivity=8)
    rows = np.arange(height, dtype=np.int64) * small[1] // height
    columns = np.arange(width, dtype=np.int64) * small[0] // width
    fine = np.asarray(labels, np.int32)[rows[:, None], columns[None, :]]
    return np.where(ink, fine, 0).astype(np.int32), int(count)
