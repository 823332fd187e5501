"""Measures the stroke of a press, cut out and turned so that its tip lies at the left and its head at the right."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.stroke.params import PX_PER_MM, Mask, Soft
from collect.quality.ink import Ink, Point

Bits = NDArray[np.uint8]
OUTLINE_MM = 1.5
"""Bare streaks narrower than this lie inside a stroke."""
CLEFT_MM = 0.5
"""A gap wider than this is not a streak: the tuft has parted there."""
RIM_MM = 0.5
"""The edge of a stroke is never as dark as its middle."""
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
    """Where it begins, from the zero-touch point: along the heading, away from the tip, and to the left."""
    gap_mm: float
    """Widest gap between two groups of hairs, averaged over 2 mm of length."""
    bent_deg: float
    """Direction from its head to its tip, off the heading."""


def measure_mark(ink: Ink, anchor_mm: Point) -> Mark | None:
    """Measure the press's own ink; None where there is none."""
    rows, columns = np.flatnonzero(ink.own.any(axis=1)), np.flatnonzero(ink.own.any(axis=0))
    if not rows.size:
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    own, dark = ink.own[box], ink.patch.dark[box]
    x, y = ink.patch.to_px(anchor_mm)
    right_mm, left_mm = (columns[-1] + 1 - x) / PX_PER_MM, (x - columns[0]) / PX_PER_MM
    # The head is the end near the zero-touch point, whichever way this brush lies down.
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
        uneven=_unevenness(own, dark, tone),
        head_mm=(float(left_mm if flip else right_mm), head),
        gap_mm=_gap_mm(hairs),
        bent_deg=float(np.degrees(np.arctan2(abs(tip - head), reach_mm))),
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


def _unevenness(own: Mask, dark: Soft, tone: float) -> float:
    side = round(OUTLINE_MM * PX_PER_MM)
    padded = np.pad(own.astype(np.uint8), side)
    darkness = np.pad(dark, side)
    outline = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(OUTLINE_MM))
    hollow = ((outline > 0) & (darkness < 0.5 * tone)).astype(np.uint8)
    cleft = cv2.dilate(cv2.morphologyEx(hollow, cv2.MORPH_OPEN, _disc(CLEFT_MM)), _disc(2 * RIM_MM))
    core = (cv2.erode(outline, _disc(2 * RIM_MM)) > 0) & (cleft == 0)
    if np.count_nonzero(core) < LEAST_CORE_MM2 * PX_PER_MM**2:
        # Hardly more than rim or cleft: a few hairs, or crumbs.
        core = outline > 0
    values = darkness[core]
    return float(values.std() / max(float(values.mean()), 1e-3))


def _disc(diameter_mm: float) -> Bits:
    side = round(diameter_mm * PX_PER_MM) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)
