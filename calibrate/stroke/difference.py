"""Find the new stroke between two photographs of one page that may already carry ink."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.params import Floats, Gray, Mask, Soft
from brushloop.calibrate.stroke.preprocess import LIGHT_ROUNDS, parts_near, quadratic, touches_edge

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
SLIVER_MM = 0.6
"""Thinner new ink along an old edge comes from a page that moved, or from ink that ran."""
NEAR_MM = 10.0
"""New ink at this distance from where the stroke should begin counts a third."""


@dataclass(frozen=True, slots=True)
class NewStroke:
    """The new stroke."""

    mask: Mask
    """(h, w), True where ink is new."""
    soft: Soft
    """(h, w) ink from 0 to 1 where it is new, 0 elsewhere."""
    noise: float
    """Standard deviation of the difference on paper, as a share of its brightness."""
    flags: tuple[str, ...]


def new_stroke(
    before: Gray,
    after: Gray,
    px_per_mm: float,
    where: str,
    near_px: tuple[float, float] | None = None,
) -> NewStroke:
    """Find the stroke in `after` that is not in `before`, two gray photographs of one page and one size.

    `near_px` is where it should begin; of several new components the one with the most ink near it is taken. Raises
    `CaptureRefused` if there is no new stroke, or the sizes differ.
    """
    if before.shape != after.shape:
        raise CaptureRefused(
            where,
            f"is {after.shape[1]} x {after.shape[0]} px, the one before it {before.shape[1]} x {before.shape[0]} px",
        )
    shift = _shift(before, after)
    moved = cast("Gray", _moved(after, (-shift[0], -shift[1]))) if max(map(abs, shift)) > 0.02 else after
    first, second = before.astype(np.float32), moved.astype(np.float32)
    paper = _paper(first)
    clean = first > DARK_SHARE * paper
    light = _gain(first, second, clean)
    darker = np.where(clean, (first - second / light) / paper, 0.0).astype(np.float32)
    quiet = darker[clean & (darker < RIM)]
    noise = 1.4826 * float(np.median(np.abs(quiet - np.median(quiet)))) if quiet.size else 0.0
    core = max(CORE, NOISE_SIGMAS * noise)
    rim = max(RIM, 0.5 * NOISE_SIGMAS * noise)
    mask = _grown(darker, clean, core, rim, px_per_mm, near_px)
    area_mm2 = float(np.count_nonzero(mask)) / px_per_mm**2
    if area_mm2 < LEAST_MM2:
        raise CaptureRefused(where, f"shows no new stroke: {area_mm2:.1f} mm2 of new ink, {LEAST_MM2:g} needed")
    ink = float(np.quantile(darker[mask], 0.75))
    # Half way between paper and ink, so that the blur of the edge neither widens nor narrows the stroke.
    mask = mask & (darker >= max(rim, 0.5 * ink))
    soft = np.where(mask, np.clip(darker / ink, 0.0, 1.0), 0.0).astype(np.float32)
    return NewStroke(mask, soft, noise, _flags(mask, clean, shift, px_per_mm))


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


def _moved(image: Gray, by: tuple[float, float]) -> cv2.typing.MatLike:
    matrix = np.array([[1.0, 0.0, by[0]], [0.0, 1.0, by[1]]])
    return cv2.warpAffine(image, matrix, (image.shape[1], image.shape[0]), borderMode=cv2.BORDER_REPLICATE)


def _paper(first: Soft) -> Soft:
    """Brightness of the paper everywhere: closing fills the ink, blurring removes the fibres."""
    small = cv2.resize(first, None, fx=1 / SHRINK, fy=1 / SHRINK, interpolation=cv2.INTER_AREA)
    side = max(3, min(small.shape[:2]) // 4) | 1
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8), borderType=cv2.BORDER_REPLICATE)
    smooth = cv2.GaussianBlur(closed, (0, 0), side / 6.0)
    size = (first.shape[1], first.shape[0])
    return np.maximum(np.asarray(cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR), np.float32), 1.0)


def _gain(first: Soft, second: Soft, clean: Mask) -> Soft:
    """Change of the light: a quadratic surface fitted to second / first where the paper stayed clean."""
    basis = quadratic(first.shape)
    thin = (slice(None, None, 4), slice(None, None, 4))
    terms, ratio = basis[thin].reshape(-1, 6), (second / np.maximum(first, 1.0))[thin].ravel().astype(np.float64)
    use = clean[thin].ravel()
    coefficients: Floats = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], np.float64)
    for _ in range(LIGHT_ROUNDS):
        if np.count_nonzero(use) < 60:
            break
        kept = terms[use]
        coefficients = np.asarray(np.linalg.pinv(kept.T @ kept) @ (kept.T @ ratio[use]), np.float64)
        off = np.abs(ratio - terms @ coefficients)
        use = clean[thin].ravel() & (off < max(0.05, 3.0 * float(np.median(off[use]))))
    return np.maximum(basis @ coefficients, 0.05).astype(np.float32)


def _grown(
    darker: Soft,
    clean: Mask,
    core: float,
    rim: float,
    px_per_mm: float,
    near_px: tuple[float, float] | None,
) -> Mask:
    """The main component above `rim` that somewhere exceeds `core`, with the parts close to it."""
    candidate = (darker > rim).astype(np.uint8)
    side = max(1, round(SLIVER_MM * px_per_mm))
    if side > 1:
        # Only along old ink: a thin tail on clean paper is a part of the stroke.
        kernel = np.ones((side, side), np.uint8)
        old = cv2.dilate((~clean).astype(np.uint8), np.ones((2 * side + 1, 2 * side + 1), np.uint8)) > 0
        opened = cv2.morphologyEx(candidate, cv2.MORPH_OPEN, kernel)
        candidate = np.where(old, opened, candidate).astype(np.uint8)
    count, labels, _, _ = cv2.connectedComponentsWithStats(candidate, connectivity=8)
    if count <= 1:
        return np.zeros(darker.shape, np.bool_)
    flat = np.asarray(labels, np.int64).ravel()
    strong = np.bincount(flat, weights=(darker > core).ravel(), minlength=count)
    ink = np.bincount(flat, weights=np.clip(darker, 0.0, 1.0).ravel(), minlength=count)
    ink[0] = 0.0
    ink[strong < 3] = 0.0
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
        flags.append(f"crosses: {touching_mm:.1f} mm of its edge lie on older ink, where new ink cannot be seen")
    if max(map(abs, shift)) > 1.0:
        flags.append(f"moved: the page lay {np.hypot(*shift):.1f} px from where it was")
    if touches_edge(mask):
        flags.append("cut: the stroke reaches the edge of the photograph")
    return tuple(flags)
