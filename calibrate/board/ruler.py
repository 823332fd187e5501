"""A printed ruler in a scan: is the scale what the scanner says?"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.board.lens import Gray
from calibrate.errors import CalibrationError
from calibrate.stroke.params import Mask

LEAST_SLENDER = 15.0
"""A ruler's bar is so many times longer than it is thick; strokes of a brush are not."""
DARK = 110
LEAST_THICK_PX = 4.0
"""Thinner lines are frames and tables."""
INSIDE_PX = 12
"""So far from its end a bar surely has its full thickness."""


@dataclass(frozen=True, slots=True)
class Bar:
    """A straight, level bar."""

    left_px: float
    top_px: float
    length_px: float
    thickness_px: float


def bars(image: Gray, least_px: float) -> list[Bar]:
    """Level dark bars at least so long, the upper first; ends to a fraction of a pixel.

    A ruler whose bar is interrupted by ticks on one line counts as a whole: bars that follow each other are joined.
    """
    dark = (image < DARK).astype(np.uint8)
    # What stays is level, long and dark: text, strokes and frames go.
    run = max(8, round(least_px / 24.0))
    level = cv2.morphologyEx(dark, cv2.MORPH_OPEN, np.ones((1, run), np.uint8))
    joined = cv2.morphologyEx(level, cv2.MORPH_CLOSE, np.ones((1, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    found: list[Bar] = []
    for label in range(1, count):
        left, top, width, height = (int(v) for v in stats[label, :4])
        if width < least_px or width < LEAST_SLENDER * height:
            continue
        part = np.asarray(labels[top : top + height, left : left + width] == label)
        thick = float(np.median(part.sum(axis=0)))
        if thick < LEAST_THICK_PX:
            continue
        begin, end = _end(image, part, left, top, -1), _end(image, part, left, top, 1)
        found.append(Bar(begin, float(top), end - begin, thick))
    return sorted(found, key=lambda bar: bar.top_px)


def check_scale(image: Gray, px_per_mm: float, length_mm: float, where: str, within: float = 0.05) -> list[float]:
    """Relative error of `px_per_mm` by each bar that may be the ruler of `length_mm`: measured over expected, less 1.

    Raises `CalibrationError` where no bar comes within `within` of its length.
    """
    expected = length_mm * px_per_mm
    fitting = [bar for bar in bars(image, (1.0 - within) * expected) if abs(bar.length_px / expected - 1.0) < within]
    if not fitting:
        raise CalibrationError(
            where, f"shows no bar of {length_mm:g} mm ({expected:.0f} px) to within {100 * within:g} %"
        )
    return [bar.length_px / expected - 1.0 for bar in fitting]


def _end(image: Gray, part: Mask, left: int, top: int, step: int) -> float:
    """Where the gray crosses half between bar and paper beyond one end; pixel j covers [j, j + 1).

    Averaged over the rows that the bar has near that end: a sheet lies a little askew.
    """
    width = part.shape[1]
    near = width - 1 - INSIDE_PX if step > 0 else INSIDE_PX
    rows = np.flatnonzero(part[:, near]) + top
    line = image[rows[1:-1] if len(rows) > 4 else rows].astype(np.float64).mean(axis=0)
    level = (float(line[left + near]) + float(np.percentile(image, 90))) / 2.0
    at = left + near
    while 0 < at < len(line) - 1 and line[at] < level:
        at += step
    inner, outer = line[at - step], line[at]
    share = 0.5 if outer == inner else float(np.clip((level - inner) / (outer - inner), 0.0, 1.0))
    return (at - step) + 0.5 + step * share
