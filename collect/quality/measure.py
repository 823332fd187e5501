"""Measures a capture: exposure, blur and glare of the photograph, and the shape and tone of the stroke in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, apply
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.stroke import PX_PER_MM, Gray, Mask, Soft
from brushloop.collect.quality.ink import Ink, Point

Floats32 = NDArray[np.float32]
FINE_PX, WIDE_PX = 1.0, 2.0
"""Two blurs that are added; the ratio of an edge's slopes after each gives the edge's own blur."""
EDGE_SHARE = 0.02
"""Share of the frame's pixels, the steepest ones, that are taken for edges."""
LEAST_EDGE = 3.0
"""Gray levels per pixel below which a slope is not an edge."""
FEWEST_EDGES = 50
SLOPE_PX2 = 1.0 / 3.0
"""Variance of the blur that a difference over two pixels adds."""
BRIGHT_PX_PER_MM = 2.5
"""Raster on which glare is looked for."""
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


def blur_px(image: Gray) -> float | None:
    """Standard deviation of the blur of the steepest edges, the worse of both directions; None without any edge.

    After S. Zhuo and T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44(9), 2011: the
    gradient of a step of blur s, blurred again by a, is proportional to 1 / sqrt(s^2 + a^2). Two such blurs give s,
    whatever the contrast. At a contrast of less than 80 levels, rounding makes s up to a third too large or small.
    """
    exact = image.astype(np.float32)
    fine, wide = (np.asarray(cv2.GaussianBlur(exact, (0, 0), s_px), np.float32) for s_px in (FINE_PX, WIDE_PX))
    across = np.array([[-0.5, 0.0, 0.5]], np.float32)
    found = [s for kernel in (across, across.T) if (s := _blur_along(fine, wide, kernel)) is not None]
    return max(found) if found else None


def _blur_along(fine_smooth: Floats32, wide_smooth: Floats32, kernel: Floats32) -> float | None:
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


def _slope(smooth: Floats32, kernel: Floats32) -> Floats32:
    return np.abs(cv2.filter2D(smooth, cv2.CV_32F, kernel)).astype(np.float32)


def edge_mm(points_mm: Floats, plane: Plane, shape: tuple[int, ...]) -> float:
    """Distance of the outermost of (n, 2) points of the paper from the edge of the frame; negative beyond it."""
    pixels = apply(np.asarray(np.linalg.inv(plane.homography), np.float64), points_mm)
    most = np.array([shape[1], shape[0]]) - 1.0
    return float(min(pixels.min(), (most - pixels).min()) * plane.mm_per_px)


def glare(raster: Gray, share: float) -> Mask:
    """Where a rectified window at 20 px/mm glares, at 2.5 px/mm: saturated, or a spot brighter than its surroundings.

    A spot is what a morphological opening removes; slopes and steps of the light, such as the edge of a shadow, stay.
    """
    height, width = (round(side * BRIGHT_PX_PER_MM / PX_PER_MM) for side in raster.shape)
    small = np.asarray(cv2.resize(raster, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    full = cv2.erode(raster, np.ones((5, 5), np.uint8)) >= SATURATED
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


Bits = NDArray[np.uint8]
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
    widest = np.zeros(round(GAP_SHARE * hairs.shape[1]))
    for column in range(widest.size):
        inked = np.flatnonzero(hairs[:, column])
        if inked.size > 1:
            widest[column] = np.diff(inked).max() - 1
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


def _disc(diameter_mm: float) -> Bits:
    side = round(diameter_mm * PX_PER_MM) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
