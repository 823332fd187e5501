"""A coarse photograph blurs the edge of a mark over more of it: a sound mark is not called dry for that."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from brushloop.calibrate.stroke import PX_PER_MM
from brushloop.collect.quality.measure import Ink, Window, measure_mark
from brushloop.collect.rig.config_touch import QualityConfig


@pytest.mark.parametrize("photo_px_per_mm", [6.25, 3.3, 2.5])
def test_an_even_mark_is_even_at_any_resolution(photo_px_per_mm: float) -> None:
    mark = measure_mark(photographed(photo_px_per_mm), (20.0, 7.0))
    assert mark is not None
    assert mark.uneven < 0.25 * QualityConfig().uneven


def photographed(photo_px_per_mm: float) -> Ink:
    """An even ellipse of 24 x 8 mm in a window of 30 x 14 mm."""
    sharp = np.zeros((round(14 * PX_PER_MM), round(30 * PX_PER_MM)), np.float32)
    half = round(12 * PX_PER_MM), round(4 * PX_PER_MM)
    cv2.ellipse(sharp, (sharp.shape[1] // 2, sharp.shape[0] // 2), half, 0.0, 0.0, 360.0, 0.85, cv2.FILLED)
    share = photo_px_per_mm / PX_PER_MM
    photo = cv2.GaussianBlur(cv2.resize(sharp, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    dark = np.asarray(cv2.resize(photo, sharp.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    raster = (255.0 * (1.0 - dark)).astype(np.uint8)
    window = Window((0.0, 0.0, 30.0, 14.0), raster, dark, np.ones(dark.shape, np.bool_), 1.0 / photo_px_per_mm)
    return Ink(window, dark > 0.2, 0.0, 0.0)
