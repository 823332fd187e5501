"""Length, width and area of a stroke in mm, straight from its mask."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.stroke.params import PX_PER_MM, Mask

GAP_MM = 1.5
"""Bare streaks and glare narrower than this lie inside a stroke, not between two."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A stroke's size. `heading` is the image's x axis."""

    length_mm: float
    """Extent along the heading."""
    width_mm: float
    """Diameter of the largest circle that fits inside the outline: the greatest width, also of a bent stroke."""
    mid_width_mm: float
    """The same over the middle third of the length, without the blobs where a drag begins and ends."""
    breadth_mm: float
    """Greatest extent across the heading; equals the width only for a straight stroke."""
    area_mm2: float
    """Area of the ink, without its holes."""


def measure(mask: Mask) -> Measured:
    """Measure a non-empty mask at 20 px/mm."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    stroke = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    filled = outline(stroke)
    inside = cv2.distanceTransform(np.pad(filled, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[:, 1:-1]
    third = stroke.shape[1] // 3
    middle = inside[:, third : stroke.shape[1] - third]
    return Measured(
        length_mm=stroke.shape[1] / PX_PER_MM,
        width_mm=_diameter_mm(float(inside.max())),
        mid_width_mm=_diameter_mm(float(middle.max())),
        breadth_mm=float(filled.sum(axis=0).max()) / PX_PER_MM,
        area_mm2=float(np.count_nonzero(stroke)) / PX_PER_MM**2,
    )


def outline(mask: Mask) -> NDArray[np.uint8]:
    """The mask with gaps of up to `GAP_MM` closed and holes filled: glare and bare bristles do not narrow a stroke."""
    side = round(GAP_MM * PX_PER_MM) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    # Padded, so that the border of the image counts as paper and closing has room.
    padded = cv2.morphologyEx(np.pad(mask.astype(np.uint8), side), cv2.MORPH_CLOSE, kernel)
    paper = padded.copy()
    cv2.floodFill(paper, None, (0, 0), (1,))
    filled = np.where(paper == 0, 1, padded).astype(np.uint8)
    return filled[side:-side, side:-side]


def _diameter_mm(reach_px: float) -> float:
    # The transform measures to the centre of the nearest paper pixel, half a pixel farther than the edge.
    return 2.0 * (reach_px - 0.5) / PX_PER_MM
