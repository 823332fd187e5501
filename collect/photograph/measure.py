"""Measures a capture: the photograph itself, the ink in a window of the paper, and shape and tone of the stroke."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, apply
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, Gray, Mask, Soft, flatten, rectify

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
    """A window of the paper, row 0 at its far edge."""

    window_mm: Rect
    dark: Soft
    """(h, w) 0 = paper, 1 = reflects nothing; 0 beyond the frame."""
    in_view: Mask
    """(h, w) False where the photograph does not reach."""
    pixel_mm: float
    """Side of a pixel of the photograph, on the paper."""
    px_per_mm: float = PX_PER_MM

    def to_px(self, point_mm: Point) -> Point:
        """(x, y) on the raster, where pixel j covers [j, j + 1)."""
        x, y, _, height = self.window_mm
        return (point_mm[0] - x) * self.px_per_mm, (y + height - point_mm[1]) * self.px_per_mm

    def inside(self, rect_mm: Rect) -> tuple[slice, slice]:
        """Rows and columns of a rectangle, clipped to the window."""
        left, bottom = self.to_px((rect_mm[0], rect_mm[1]))
        right, top = self.to_px((rect_mm[0] + rect_mm[2], rect_mm[1] + rect_mm[3]))
        return slice(max(round(top), 0), max(round(bottom), 0)), slice(max(round(left), 0), max(round(right), 0))

    def inked(self, gate: float) -> Mask:
        """(h, w) True where there is ink, after noise and grain are smoothed away."""
        return np.asarray(cv2.GaussianBlur(self.dark, (0, 0), GRAIN_MM * self.px_per_mm), np.float32) > gate

    def points_mm(self, mask: Mask) -> Floats:
        """(n, 2) centres of a mask's pixels in the paper frame."""
        x, y, _, height = self.window_mm
        rows, columns = np.nonzero(mask)
        places = np.column_stack([x + (columns + 0.5) / self.px_per_mm, y + height - (rows + 0.5) / self.px_per_mm])
        return places.astype(np.float64)


def take(image: Gray, plane: Plane, window_mm: Rect, px_per_mm: float = PX_PER_MM) -> Window:
    """Rectify a window of an (h, w) photograph and divide it by its illumination."""
    raster = rectify(image, plane.homography, window_mm, px_per_mm)
    x, y, width, height = window_mm
    corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
    seen = apply(np.asarray(np.linalg.inv(plane.homography), np.float64), corners)
    in_view = np.ones(raster.shape, np.bool_)
    if seen.min() < 0.0 or bool((seen > np.array(image.shape[::-1]) - 1.0).any()):
        # `rectify` repeats the frame's outermost pixels: mark them, to see where it did.
        shown = np.full(image.shape, 255, np.uint8)
        shown[[0, -1]] = 0
        shown[:, [0, -1]] = 0
        in_view = rectify(shown, plane.homography, window_mm, px_per_mm) > 127
    dark = np.where(in_view, 1.0 - flatten(raster, px_per_mm), 0.0).astype(np.float32)
    pixel_mm = math.sqrt(width * height / cv2.contourArea(seen.astype(np.float32)))
    return Window(window_mm, dark, in_view, pixel_mm, px_per_mm)


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
    """Find the press's own ink: new since `before` if that is given, in one piece, and near the anchor.

    `now` is at 20 px/mm, `before` at any scale.
    """
    ink = now.inked(gate)
    patch = now.inside(cell_mm)
    before_mm2 = 0.0
    if before is not None:
        old = cv2.resize(before.inked(gate).astype(np.uint8), ink.shape[::-1], interpolation=cv2.INTER_NEAREST)
        before_mm2 = mm2(old[patch] > 0)
        side = round(SEAM_MM * PX_PER_MM) | 1
        ink &= cv2.dilate(old, np.ones((side, side), np.uint8)) == 0
    # Without a photograph from before, a piece that lies mostly in the next patch is taken to belong there.
    least_share = HOME_SHARE if before is None else 0.0
    own, beside_mm2 = _own_piece(ink, now.to_px(anchor_mm), patch, least_share)
    return Ink(now, own, before_mm2, beside_mm2)


def mm2(mask: Mask) -> float:
    """Area of a mask at 20 px/mm."""
    return float(np.count_nonzero(mask)) / PX_PER_MM**2


def _own_piece(ink: Mask, anchor_px: Point, patch: tuple[slice, slice], least_share: float) -> tuple[Mask, float]:
    """(the stroke's piece, at least `least_share` of which lies in the patch; mm^2 of the other pieces in it)."""
    pieces, count = _pieces(ink)
    areas = np.bincount(pieces[ink], minlength=count) / PX_PER_MM**2
    in_cell = np.bincount(pieces[patch][ink[patch]], minlength=count) / PX_PER_MM**2
    at_home = np.where(in_cell >= least_share * areas, areas, 0.0)
    if at_home.max() == 0.0:
        return np.zeros_like(ink), float(in_cell[in_cell >= SMALLEST_MM2].sum())
    rows, columns = np.nonzero(ink)
    near = np.hypot(columns + 0.5 - anchor_px[0], rows + 0.5 - anchor_px[1]) <= NEAR_MM * PX_PER_MM
    touches = np.bincount(pieces[ink][near], minlength=count) > 0
    candidates = np.flatnonzero(touches & (at_home > 0.0) & (at_home >= NEAR_SHARE * at_home.max()))
    main = int(candidates[np.argmax(at_home[candidates])]) if candidates.size else int(np.argmax(at_home))
    in_cell[main] = 0.0
    return ink & (pieces == main), float(in_cell[in_cell >= SMALLEST_MM2].sum())


def _pieces(ink: Mask) -> tuple[NDArray[np.uint16], int]:
    """(h, w) number of the piece that each inked pixel belongs to, and how many numbers there are."""
    height, width = ink.shape
    small = (max(width // COARSE, 1), max(height // COARSE, 1))
    share = cv2.resize(ink.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    side = round(JOIN_MM * PX_PER_MM / COARSE) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    joined = cv2.morphologyEx(np.pad((share > 0.0).astype(np.uint8), side), cv2.MORPH_CLOSE, kernel)
    count, labels = cv2.connectedComponents(
        np.ascontiguousarray(joined[side:-side, side:-side]), connectivity=8, ltype=cv2.CV_16U
    )
    return np.asarray(cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST), np.uint16), int(count)


FINE_PX, WIDE_PX = 1.0, 2.0
"""Two blurs that are added; the ratio of an edge's slopes after each gives the edge's own blur."""
TILES = 4
"""Rows and columns of tiles in a frame."""
EDGE_SHARE = 0.02
"""Share of the pixels, the steepest ones, that are taken for edges."""
LEAST_EDGE = 3.0
"""Gray levels per pixel below which a slope is not an edge."""
FEWEST_EDGES = 50
SLOPE_PX2 = 1.0 / 3.0
"""Variance of the blur that a difference over two pixels adds."""
COARSE_PX_PER_MM, BRIGHT_PX_PER_MM = 10.0, 2.5
"""Rasters on which saturated pixels and bright spots are looked for; a photograph has about 6 px/mm."""
INK_WIDTH_MM = 20.0
"""Strokes are narrower than this: closing fills them with the paper beside them."""
SPOT_MM = 36.0
"""A bright area wider than this is uneven illumination, not glare."""
SATURATED = 252


def paper_level(image: Gray) -> float:
    """Gray level of the bright part of the frame, its paper."""
    small = image[::4, ::4]
    otsu, _ = cv2.threshold(np.ascontiguousarray(small), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    bright = small[small > otsu]
    return float(np.median(bright)) if bright.size else float(np.median(small))


def busiest_tile(image: Gray) -> Gray:
    """The one of `TILES` x `TILES` parts of an (h, w) frame that has most contrast: the board, where it is in view."""
    rows, columns = (np.arange(TILES + 1) * side // TILES for side in image.shape)
    tiles = [image[top:low, left:right] for top, low in pairwise(rows) for left, right in pairwise(columns)]
    return np.ascontiguousarray(max(tiles, key=lambda tile: float(tile[::TILES, ::TILES].std())))


def blur_px(image: Gray) -> float | None:
    """Standard deviation of the blur of the steepest edges, the worse of both directions; None without any edge.

    After S. Zhuo and T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44(9), 2011: the
    gradient of a step of blur s, blurred again by a, is proportional to 1 / sqrt(s^2 + a^2). Two such blurs give s,
    whatever the contrast. At a contrast of less than 80 levels, rounding makes s up to a third too large or small.
    """
    exact = image.astype(np.float32)
    fine, wide = (np.asarray(cv2.GaussianBlur(exact, (0, 0), s_px), np.float32) for s_px in (FINE_PX, WIDE_PX))
    across = np.array([[-0.5, 0.0, 0.5]], np.float32)
    blurs_px = [s for kernel in (across, across.T) if (s := _blur_along(fine, wide, kernel)) is not None]
    return max(blurs_px) if blurs_px else None


def _blur_along(fine_smooth: Soft, wide_smooth: Soft, kernel: Soft) -> float | None:
    fine = _slope(fine_smooth, kernel)
    # At the crest of an edge only its blur matters, not the thickness of the line.
    crest = fine == cv2.dilate(fine, np.ones((1, 7) if len(kernel) == 1 else (7, 1), np.uint8))
    steep = fine[crest & (fine > LEAST_EDGE)]
    if steep.size < FEWEST_EDGES:
        return None
    least = np.quantile(steep, 1.0 - min(1.0, max(EDGE_SHARE, 500 / steep.size)))
    chosen = crest & (fine >= max(float(least), LEAST_EDGE))
    wide = _slope(wide_smooth, kernel)
    ratio = np.maximum(fine[chosen] / np.maximum(wide[chosen], 1e-3), 1.0 + 1e-6)
    wide2, fine2 = WIDE_PX**2 + SLOPE_PX2, FINE_PX**2 + SLOPE_PX2
    own2 = (wide2 - ratio**2 * fine2) / (ratio**2 - 1.0)
    return float(np.sqrt(np.median(np.maximum(own2, 0.0))))


def _slope(smooth: Soft, kernel: Soft) -> Soft:
    return np.abs(cv2.filter2D(smooth, cv2.CV_32F, kernel)).astype(np.float32)


def edge_mm(points_mm: Floats, plane: Plane, shape: tuple[int, ...]) -> float:
    """Distance of the outermost of (n, 2) points of the paper from the edge of the frame; negative beyond it."""
    pixels = apply(np.asarray(np.linalg.inv(plane.homography), np.float64), points_mm)
    most = np.array([shape[1], shape[0]]) - 1.0
    return float(min(pixels.min(), (most - pixels).min()) * plane.mm_per_px)


def glare(raster: Gray, share: float) -> Mask:
    """Where a rectified window at 10 px/mm glares, at 2.5 px/mm: saturated, or a spot brighter than its surroundings.

    A spot is what a morphological opening removes; slopes and steps of the light, such as the edge of a shadow, stay.
    """
    height, width = (round(side * BRIGHT_PX_PER_MM / COARSE_PX_PER_MM) for side in raster.shape)
    small = np.asarray(cv2.resize(raster, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    full = cv2.erode(raster, np.ones((3, 3), np.uint8)) >= SATURATED
    saturated = cv2.resize(full.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    level = _morph(np.asarray(cv2.medianBlur(small, 3), np.uint8), cv2.MORPH_CLOSE, INK_WIDTH_MM)
    base = _morph(level, cv2.MORPH_OPEN, SPOT_MM)
    spot = level.astype(np.float32) > (1.0 + share) * np.maximum(base.astype(np.float32), 1.0)
    return saturated | spot


def _morph(image: NDArray[np.uint8], operation: int, width_mm: float) -> NDArray[np.uint8]:
    side = round(width_mm * BRIGHT_PX_PER_MM) | 1
    # Padded: a border rule acts on each half of the operation alone, and would remove a bright strip at the border.
    padded = cv2.copyMakeBorder(image, side, side, side, side, cv2.BORDER_REPLICATE)
    changed = cv2.morphologyEx(padded, operation, np.ones((side, side), np.uint8))
    return np.asarray(changed[side:-side, side:-side], np.uint8)


OUTLINE_MM = 1.5
"""Bare streaks narrower than this lie inside a stroke."""
CLEFT_MM = 0.5
"""A gap wider than this is not a streak: the tuft has parted there."""
RIM_MM = 0.5
"""The edge of a stroke is never as dark as its middle."""
RIM_PX = 2.3
"""Pixels of the photograph over which an edge is blurred; in a coarse photograph they are wider than `RIM_MM`."""
HEAD_SHARE = 0.4
"""Share of the length, from the head, that shows where the stroke begins and in what direction."""
TIP_SHARE = 0.1
GAP_SHARE = 0.6
"""Share of the length, from the tip, in which hairs may part."""
GAP_RUN_MM = 2.0
TONE_QUANTILE = 0.75
LEAST_CORE_MM2 = 0.5


@dataclass(frozen=True, slots=True)
class Mark:
    """One press's stroke, measured."""

    tone: float
    """Upper quartile of the darkness of its ink; 1 reflects nothing."""
    uneven: float
    """Standard deviation of darkness over mean, within its outline without rim and cleft."""
    head_mm: Point
    """Where it begins, from the zero-touch point: along the heading, positive away from the tip; and to the left."""
    gap_mm: float
    """Widest gap between two groups of hairs, averaged over 2 mm of length."""
    bent_deg: float
    """Angle between the heading and the direction from its head to its tip."""
    length_mm: float
    """Along the heading."""
    width_mm: float


def measure_mark(ink: Ink, anchor_mm: Point) -> Mark | None:
    """Measure the press's own ink; None if it left no ink."""
    rows, columns = np.flatnonzero(ink.own.any(axis=1)), np.flatnonzero(ink.own.any(axis=0))
    if not rows.size:
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    own, dark = ink.own[box], ink.window.dark[box]
    x, y = ink.window.to_px(anchor_mm)
    right_mm, left_mm = (columns[-1] + 1 - x) / PX_PER_MM, (x - columns[0]) / PX_PER_MM
    # The head is the end near the zero-touch point, to whichever side the brush bends.
    flip = abs(left_mm) < abs(right_mm)
    if flip:
        own, dark = own[:, ::-1], dark[:, ::-1]
    tone = float(np.quantile(dark[own], TONE_QUANTILE))
    hairs = own & (dark > 0.5 * tone)
    if not hairs.any():
        hairs = own
    spine = _spine(hairs)
    aside_mm = (y - rows[0] - spine) / PX_PER_MM
    length = own.shape[1]
    head = float(np.nanmedian(aside_mm[length - max(round(HEAD_SHARE * length), 1) :]))
    tip = float(np.nanmedian(aside_mm[: max(round(TIP_SHARE * length), 1)]))
    reach_mm = max((1.0 - 0.5 * (HEAD_SHARE + TIP_SHARE)) * length / PX_PER_MM, 1e-3)
    return Mark(
        tone=tone,
        uneven=_unevenness(own, dark, tone, max(RIM_MM, RIM_PX * ink.window.pixel_mm)),
        head_mm=(float(left_mm if flip else right_mm), head),
        gap_mm=_gap_mm(hairs),
        bent_deg=float(np.degrees(np.arctan2(abs(tip - head), reach_mm))),
        length_mm=length / PX_PER_MM,
        width_mm=own.shape[0] / PX_PER_MM,
    )


def _spine(hairs: Mask) -> NDArray[np.float64]:
    """(w,) row of the middle of each column; bare columns repeat the one before."""
    full = hairs.any(axis=0)
    top, bottom = hairs.argmax(axis=0), hairs.shape[0] - hairs[::-1].argmax(axis=0)
    at = np.flatnonzero(full)
    middle = 0.5 * (top + bottom).astype(np.float64)
    columns = np.arange(hairs.shape[1], dtype=np.int64)
    before = np.maximum(np.searchsorted(at, columns, side="right") - 1, 0)
    return middle[at[before]]


def _gap_mm(hairs: Mask) -> float:
    tip = hairs[:, : round(GAP_SHARE * hairs.shape[1])]
    rows = np.where(tip, np.arange(len(tip))[:, None], -1)
    above = np.maximum.accumulate(rows, axis=0)[:-1]  # the inked row before, of each pixel from the second row on
    widest = np.where(tip[1:] & (above >= 0), rows[1:] - above - 1, 0).max(axis=0, initial=0)
    run = round(GAP_RUN_MM * PX_PER_MM)
    if widest.size < run:
        return 0.0
    return float(np.convolve(widest, np.ones(run) / run, mode="valid").max()) / PX_PER_MM


def _unevenness(own: Mask, dark: Soft, tone: float, rim_mm: float) -> float:
    side = round(OUTLINE_MM * PX_PER_MM)
    padded = np.pad(own.astype(np.uint8), side)
    darkness = np.pad(dark, side)
    outline = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(OUTLINE_MM))
    hollow = ((outline > 0) & (darkness < 0.5 * tone)).astype(np.uint8)
    cleft = cv2.dilate(cv2.morphologyEx(hollow, cv2.MORPH_OPEN, _disc(CLEFT_MM)), _disc(2 * rim_mm))
    core = (cv2.erode(outline, _disc(2 * rim_mm)) > 0) & (cleft == 0)
    if np.count_nonzero(core) < LEAST_CORE_MM2 * PX_PER_MM**2:
        # Little more than rim or cleft: a few hairs, or specks.
        core = outline > 0
    values = darkness[core]
    return float(values.std() / max(float(values.mean()), 1e-3))


def _disc(diameter_mm: float) -> Gray:
    side = round(diameter_mm * PX_PER_MM) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
