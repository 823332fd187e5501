"""Select the ink of the stroke: components, specks, neighbours and holes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.stroke.params import PX_PER_MM, Mask, Params


@dataclass(frozen=True, slots=True)
class Chosen:
    """The stroke among the components, and what was left out."""

    mask: Mask
    parts: int
    specks: int
    others_mm2: tuple[float, ...]
    """Areas of components that are not specks and belong to other strokes."""


def components(ink: Mask, anchor_px: tuple[float, float] | None, params: Params) -> Chosen:
    """Select the stroke: the main component, and parts close to it that are not specks.

    The main component is the largest; with an anchor, the largest of those that come within `join_mm` of it, if any.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8), connectivity=8)
    if count <= 1:
        return Chosen(np.zeros_like(ink), 0, 0, ())
    areas = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.int64)
    candidates = np.arange(1, count)
    if anchor_px is not None:
        near = _within(labels.astype(np.int32), anchor_px, params.join_mm * PX_PER_MM)
        near = near[areas[near - 1] >= params.speck_share * areas.max()]
        candidates = near if near.size else candidates
    main = int(candidates[np.argmax(areas[candidates - 1])])
    others = [k for k in range(1, count) if k != main and areas[k - 1] >= params.speck_share * areas[main - 1]]
    specks = count - 2 - len(others)
    near = parts_near(labels, main, others, params.join_mm * PX_PER_MM)
    foreign = tuple(float(areas[label - 1]) / PX_PER_MM**2 for label in others if label not in near)
    return Chosen(np.isin(labels, [main, *near]), 1 + len(near), specks, foreign)


def parts_near(labels: cv2.typing.MatLike, main: int, others: list[int], reach_px: float) -> list[int]:
    """Those of the `others` that come within `reach_px` of the component `main`; `labels` (h, w) numbers them all."""
    if not others:
        return []
    away = np.asarray(cv2.distanceTransform((labels != main).astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    return [label for label in others if float(away[labels == label].min()) <= reach_px]


def fill_holes(mask: Mask, params: Params) -> Mask:
    """The mask with its holes of up to `hole_mm2` filled."""
    if params.hole_mm2 <= 0.0:
        return mask
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~np.pad(mask, 1)).astype(np.uint8), connectivity=4)
    small = np.zeros(count, np.bool_)
    small[1:] = stats[1:, cv2.CC_STAT_AREA] <= params.hole_mm2 * PX_PER_MM**2
    filled = small[np.asarray(labels, np.int64)]
    return mask | filled[1:-1, 1:-1]


def _within(labels: NDArray[np.int32], point: tuple[float, float], radius: float) -> NDArray[np.int64]:
    height, width = labels.shape
    reach = int(radius) + 1
    rows = slice(max(int(point[1]) - reach, 0), min(int(point[1]) + reach + 1, height))
    columns = slice(max(int(point[0]) - reach, 0), min(int(point[0]) + reach + 1, width))
    ys, xs = np.ogrid[rows, columns]
    close = (xs + 0.5 - point[0]) ** 2 + (ys + 0.5 - point[1]) ** 2 <= radius**2
    found = np.unique(labels[rows, columns][close]).astype(np.int64)
    return found[found > 0]
