"""Strokes that can be used, but say less about the brush."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from brushloop.calibrate.drags.measure import along_axis, defects
from brushloop.calibrate.stroke.measure import measure


def bar(angle_deg: float = 0.0) -> np.ndarray:
    """A stroke of 20 x 3 mm."""
    box = cv2.boxPoints(((300.0, 300.0), (400.0, 60.0), angle_deg))
    return cv2.fillPoly(np.zeros((600, 600), np.uint8), [np.rint(box).astype(np.int32)], 1).astype(bool)


def test_torn_and_hollow_strokes_are_named_and_whole_ones_are_not() -> None:
    assert defects(bar()) == ()
    torn = bar()
    torn[:, 350:380] = False
    assert defects(torn)[0].startswith("torn: 2 parts")
    hollow = bar()
    hollow[280:320, 120:480] = False
    assert defects(hollow)[0].startswith("hollow: ink covers")


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0, -60.0])
def test_the_length_of_a_stroke_is_along_its_own_axis(angle_deg: float) -> None:
    size = measure(along_axis(bar(angle_deg)))
    assert (size.length_mm, size.width_mm) == pytest.approx((20.0, 3.0), abs=0.25)
