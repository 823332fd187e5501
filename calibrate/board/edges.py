"""Corners of a board as crossings of its edges, each edge followed for half a square.

A window around the corner sees few pixels of each edge, and where the edge runs along the pixel rows they all have the
same error. Half a square crosses pixel rows at several phases, and their errors cancel.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, Gray

ALONG_SHARE = 0.45
"""How far an edge is followed to either side, as a share of a square."""
MOST_ALONG_PX = 40
ACROSS_SHARE = 0.6
"""Distance searched across an edge, as a share of the distance to the next one."""
MOST_ACROSS_PX = 6
LEAST_ACROSS_PX = 2.5
CORNER_PX = 3
"""Distance from the corner within which the two edges blur into each other."""
LEAST_CONTRAST = 0.4
"""Least contrast, as a share of the median: less is a shadow, a fold, or the edge of a sheet on the board."""
LEAST_SEEN = 0.6
MOST_WALK_PX = 1.5


def on_edges(image: Gray, pixels: Floats, right_px: Floats, down_px: Floats, gap_px: float) -> Floats:
    """(n, 2) corners moved to where their edges cross; those whose edges are not seen well enough stay.

    `right_px` and `down_px` are (n, 2): from each corner one square to the right and one down on the board. `gap_px` is
    the distance from an edge to the nearest marker or edge.
    """
    across = min(MOST_ACROSS_PX, ACROSS_SHARE * gap_px)
    if across < LEAST_ACROSS_PX or not len(pixels):
        return pixels
    moved = pixels.copy()
    first = _edge(image, pixels, right_px, across)
    second = _edge(image, pixels, down_px, across)
    for k, corner in enumerate(pixels):
        rows = [
            (normal[k] - slope[k] * direction[k], offset[k])
            for direction, normal, offset, slope, seen in (first, second)
            if seen[k]
        ]
        if len(rows) < 2:
            continue
        step = np.linalg.solve(np.array([row for row, _ in rows]), np.array([off for _, off in rows]))
        if np.linalg.norm(step) <= MOST_WALK_PX:
            moved[k] = corner + step
    return moved


def _edge(
    image: Gray, pixels: Floats, towards_px: Floats, across: float
) -> tuple[Floats, Floats, Floats, Floats, NDArray[np.bool_]]:
    """Direction and normal (n, 2) of the edge through each corner; its offset, slope and whether it is seen (n,)."""
    length = np.linalg.norm(towards_px, axis=1)
    direction = towards_px / length[:, None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    reach = int(np.clip(round(ALONG_SHARE * float(length.min())), CORNER_PX + 2, MOST_ALONG_PX))
    t = np.array([s for s in range(-reach, reach + 1) if abs(s) >= CORNER_PX], np.float64)
    s = np.arange(-round(2 * across), round(2 * across) + 1) / 2.0
    places = (
        pixels[:, None, None]
        + t[None, :, None, None] * direction[:, None, None]
        + s[None, None, :, None] * normal[:, None, None]
    )
    flat = places.reshape(len(pixels), -1, 2).astype(np.float32)
    levels = np.asarray(cv2.remap(image, flat, np.empty(0), cv2.INTER_LINEAR), np.float64)
    steps = np.diff(levels.reshape(len(pixels), len(t), len(s)), axis=2)
    between = (s[1:] + s[:-1]) / 2.0
    # Dark and light swap sides at the corner, so each side has its own sign.
    for side in (t < 0, t > 0):
        sign = np.sign(steps[:, side].sum(axis=(1, 2)))
        steps[:, side] *= np.where(sign == 0.0, 1.0, sign)[:, None, None]
    contrast = steps.sum(axis=2)
    good = contrast > LEAST_CONTRAST * float(np.median(contrast))
    offsets = (steps * between).sum(axis=2) / np.where(good, contrast, 1.0)
    offset, slope = np.zeros(len(pixels)), np.zeros(len(pixels))
    seen = (good[:, t < 0].mean(axis=1) >= LEAST_SEEN) & (good[:, t > 0].mean(axis=1) >= LEAST_SEEN)
    # A lens bends edges, so a parabola is fitted; its value at the corner is the offset.
    terms = np.stack([np.ones_like(t), t, t * t], axis=1)
    for k in np.flatnonzero(seen):
        use = good[k]
        found = _parabola(terms[use], offsets[k, use])
        left = np.abs(offsets[k] - terms @ found)
        use = use & (left < max(0.5, 3.0 * float(np.median(left[use]))))
        found = _parabola(terms[use], offsets[k, use])
        offset[k], slope[k] = found[0], found[1]
    return direction, normal, offset, slope, seen


def _parabola(terms: Floats, offsets: Floats) -> Floats:
    found, *_rest = np.linalg.lstsq(terms, offsets, rcond=None)
    return np.asarray(found, np.float64)
