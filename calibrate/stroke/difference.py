"""Find the new stroke between two photographs of one page that may already carry ink."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.preprocess import Gray, Mask, Soft, light_surface, parts_near, touches_edge

DARK_SHARE = 0.6
"""A pixel darker than this share of the paper held ink before: new ink on top of it cannot be seen."""
SHRINK = 8
MOST_SHIFT_PX = 8.0
LEAST_CORRELATION = 0.5
"""Of the two photographs once they are aligned; below it there is nothing to align by."""
BLURS_PX = (17, 5)
"""The wide blur finds the shift from afar, the narrow one to a fifth of a pixel."""
UNTIL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-3)
"""Most iterations of the alignment, and the growth of the correlation at which it ends."""
NEW_INK_GRAY = 40
RIM_PX = 9
"""Width of the square by which new ink is grown to hold its blurred edge as well."""
NOISE_SIGMAS = 6.0
CORE = 0.35
"""Darkening, as a share of the paper's brightness, that a stroke must reach somewhere."""
RIM = 0.15
"""Darkening above which its neighbours belong to it."""
JOIN_MM = 2.0
"""Parts that lie closer to the main part are the same stroke: bristles part, bubbles shine."""
LEAST_MM2 = 2.0
"""Less new ink than this is no stroke."""
WIDTH_MM, TIP_MM = 6.0, 2.0
"""Lengths from the left end within which the width at the start, and the height of the start on the page, are found."""
NEAR_MM = 10.0
"""New ink at this distance from where the stroke should begin counts a third."""


@dataclass(frozen=True, slots=True)
class NewStroke:
    """The new stroke."""

    mask: Mask
    """(h, w), True where ink is new."""
    soft: Soft
    """(h, w) ink from 0 to 1 where it is new, 0 elsewhere."""
    flags: tuple[str, ...]

    def start_px(self, px_per_mm: float) -> tuple[float, float]:
        """Where the brush touched the paper, (x, y), for a stroke that runs to the right.

        A brush leaves a round mark about its touch, so the touch lies half the width at the start to the right of the
        left end.
        """
        widths = self.mask.sum(axis=0)
        left = int(np.flatnonzero(widths)[0])
        width_px = float(widths[left : left + round(WIDTH_MM * px_per_mm)].max())
        rows = self.soft[:, left : left + round(TIP_MM * px_per_mm)].sum(axis=1)
        return left + 0.5 * width_px, float(np.average(np.arange(len(rows)) + 0.5, weights=rows))


def new_stroke(
    before: Gray, after: Gray, px_per_mm: float, where: str, near_px: tuple[float, float] | None = None
) -> NewStroke:
    """Find the stroke in `after` that is not in `before`, two gray photographs of one page and one size.

    `near_px` is where it should begin; of several new components the one with the most ink near it is taken. Raises
    `CaptureRefused` if there is no new stroke, or the sizes differ.
    """
    if before.shape != after.shape:
        sizes = [f"{image.shape[1]} x {image.shape[0]} px" for image in (after, before)]
        raise CaptureRefused(where, f"is {sizes[0]}, but the photograph before it is {sizes[1]}")
    shift = _shift(before, after)
    back = np.array([[1.0, 0.0, -shift[0]], [0.0, 1.0, -shift[1]]])
    aligned = cv2.warpAffine(after, back, after.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    first, second = _reflectance(before), _reflectance(cast("Gray", aligned))
    clean = first > DARK_SHARE
    darker = np.where(clean, first - second, 0.0).astype(np.float32)
    quiet = darker[clean & (darker < RIM)]
    noise = 1.4826 * float(np.median(np.abs(quiet - np.median(quiet)))) if quiet.size else 0.0
    core, rim = max(CORE, NOISE_SIGMAS * noise), max(RIM, 0.5 * NOISE_SIGMAS * noise)
    mask = _grown(darker, core, rim, px_per_mm, near_px)
    area_mm2 = float(np.count_nonzero(mask)) / px_per_mm**2
    if area_mm2 < LEAST_MM2:
        raise CaptureRefused(where, f"shows no new stroke: {area_mm2:.1f} mm2 of new ink, {LEAST_MM2:g} are needed")
    ink = float(np.quantile(darker[mask], 0.75))
    # Half way between paper and ink, so that the blur of the edge neither widens nor narrows the stroke.
    mask = mask & (darker >= max(rim, 0.5 * ink))
    soft = np.where(mask, np.clip(darker / ink, 0.0, 1.0), 0.0).astype(np.float32)
    return NewStroke(mask, soft, _flags(mask, clean, shift, px_per_mm))


def _shift(before: Gray, after: Gray) -> tuple[float, float]:
    """How far the page moved, (x, y) px; 0 where the two photographs do not determine it."""
    # New ink must not affect the shift. It is darker than everything that a shift could have brought to its place.
    around = np.ones((2 * round(MOST_SHIFT_PX) + 1,) * 2, np.uint8)
    new = (cv2.subtract(cv2.erode(before, around), after) > NEW_INK_GRAY).astype(np.uint8)
    comparable = (cv2.dilate(new, np.ones((RIM_PX, RIM_PX), np.uint8)) == 0).astype(np.uint8)
    warp, correlation = np.eye(2, 3, dtype=np.float32), 0.0
    try:
        for blur_px in BLURS_PX:
            correlation, found = cv2.findTransformECC(
                before, after, warp, cv2.MOTION_TRANSLATION, UNTIL, comparable, blur_px
            )
            warp = np.asarray(found, np.float32)
    except cv2.error:  # it does not converge where there is nothing to see
        return 0.0, 0.0
    dx, dy = (float(v) for v in warp[:, 2])
    return (dx, dy) if correlation >= LEAST_CORRELATION and max(abs(dx), abs(dy)) <= MOST_SHIFT_PX else (0.0, 0.0)


def _reflectance(image: Gray) -> Soft:
    """Brightness as a share of the paper's, under a light that changes smoothly over the page."""
    small = cast("Gray", cv2.resize(image, None, fx=1 / SHRINK, fy=1 / SHRINK, interpolation=cv2.INTER_AREA))
    light = light_surface(small).astype(np.float32)
    paper = cv2.resize(light, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return (image / paper).astype(np.float32)


def _grown(darker: Soft, core: float, rim: float, px_per_mm: float, near_px: tuple[float, float] | None) -> Mask:
    """The main component above `rim` that somewhere exceeds `core`, with the parts close to it."""
    count, labels, _, _ = cv2.connectedComponentsWithStats((darker > rim).astype(np.uint8), connectivity=8)
    flat = np.asarray(labels, np.int64).ravel()
    ink = np.bincount(flat, weights=np.clip(darker, 0.0, 1.0).ravel(), minlength=count)
    ink[np.bincount(flat, weights=(darker > core).ravel(), minlength=count) < 3] = 0.0
    ink[0] = 0.0  # the paper
    weight = ink.copy()
    if near_px is not None:
        for label in np.flatnonzero(ink > 0.0):
            ys, xs = np.nonzero(labels == label)
            away = float(np.hypot(xs + 0.5 - near_px[0], ys + 0.5 - near_px[1]).min())
            weight[label] *= np.exp(-away / (NEAR_MM * px_per_mm))
    main = int(np.argmax(weight))
    if weight[main] <= 0.0:
        return np.zeros(darker.shape, np.bool_)
    others = [int(label) for label in np.flatnonzero(ink > 0.0) if label != main]
    return np.isin(labels, [main, *parts_near(labels, main, others, JOIN_MM * px_per_mm)])


def _flags(mask: Mask, clean: Mask, shift: tuple[float, float], px_per_mm: float) -> tuple[str, ...]:
    flags: list[str] = []
    around = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    touching_mm = float(np.count_nonzero(around & ~clean)) / px_per_mm
    if touching_mm > 1.0:
        flags.append(f"crosses: {touching_mm:.1f} mm of the edge lie on older ink, where new ink cannot be seen")
    if max(map(abs, shift)) > 1.0:
        flags.append(f"moved: the page lay {np.hypot(*shift):.1f} px from its earlier place")
    if touches_edge(mask):
        flags.append("cut: the stroke reaches the edge of the photograph")
    return tuple(flags)
