"""The smallest box around what was taught, and circles through points on a rim."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from collect.teach.errors import CannotTeach

Point = tuple[float, float, float]
LEAST_RADIUS_MM, MOST_RADIUS_MM = 3.0, 150.0


def hull(
    points: Sequence[Point], margin_mm: float
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Ranges of x, y and z around these points, widened by the margin in x and y, and upward in z; rounded outward."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    return (
        (math.floor(low[0] - margin_mm), math.ceil(high[0] + margin_mm)),
        (math.floor(low[1] - margin_mm), math.ceil(high[1] + margin_mm)),
        (math.floor(10.0 * low[2]) / 10.0, math.ceil(high[2] + margin_mm)),
    )


def rim(points: Sequence[Point]) -> tuple[tuple[float, float], float, float]:
    """(centre, radius, height) of the level circle through three or more points on a rim (Coope 1993, linear).

    Raises `CannotTeach` for points that are no circle's, or not a pot's.
    """
    at = np.array(points)
    middle = at[:, :2].mean(axis=0)
    around = at[:, :2] - middle
    equations = np.column_stack([2.0 * around, np.ones(len(at))])
    solved = np.asarray(np.linalg.lstsq(equations, (around**2).sum(axis=1), rcond=None)[0], np.float64)
    x, y, rest = solved.tolist()
    radius_mm = math.sqrt(max(rest + x * x + y * y, 0.0))
    if len(at) < 3 or not LEAST_RADIUS_MM <= radius_mm <= MOST_RADIUS_MM:
        raise CannotTeach(
            f"the touched points of the rim do not lie on a pot's rim (radius {radius_mm:.0f} mm).",
            "Touch it at three places a third of the way round from each other.",
        )
    return (x + float(middle[0]), y + float(middle[1])), radius_mm, float(at[:, 2].max())
