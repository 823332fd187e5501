"""How much ink came between two photographs, at places of the paper."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.stroke.preprocess import PX_PER_MM, rectify

Floats = NDArray[np.float64]
Gray = NDArray[np.uint8]
DARK_SHARE = 0.5
"""Darker than this share of the paper is not paper: it does not count for how the light changed."""


def gray(image: NDArray[np.uint8]) -> Gray:
    """(h, w) of a (h, w) or (h, w, 3) BGR image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def new_ink(
    before: Gray, after: Gray, image_to_paper: Floats, window_mm: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """(h, w) at 20 px/mm over a window (x, y, width, height in the paper frame): how much darker it became.

    In shares of the paper's brightness, 1 being paper turned black; a change of the light is taken out. Noise averages
    to 0, so that a sum over an area is unbiased.
    """
    first, second = (rectify(image, image_to_paper, window_mm).astype(np.float32) for image in (before, after))
    paper = float(np.quantile(first, 0.9))
    clean = first > DARK_SHARE * paper
    if paper < 1.0 or not clean.any():
        return np.zeros(first.shape, np.float32)
    light = float(np.median(second[clean] / first[clean]))
    return np.asarray((first - second / max(light, 1e-3)) / paper, np.float32)


def ink_at(
    before: Gray, after: Gray, image_to_paper: Floats, spots_mm: list[tuple[float, float]], side_mm: float
) -> Floats:
    """(n,) mm2 of black that came in a square around each spot."""
    amounts: list[float] = []
    for x, y in spots_mm:
        # one side more all round, so that the median sees paper
        window = (x - 1.5 * side_mm, y - 1.5 * side_mm, 3.0 * side_mm, 3.0 * side_mm)
        darker = new_ink(before, after, image_to_paper, window)
        third = darker.shape[0] // 3
        amounts.append(float(darker[third : 2 * third, third : 2 * third].sum()) / PX_PER_MM**2)
    return np.array(amounts, np.float64)
