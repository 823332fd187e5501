"""The smallest box around what was taught."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Point = tuple[float, float, float]


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
