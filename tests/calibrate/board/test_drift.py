"""The board seen again over a session, and what a pre-flight check says of it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from brushloop.calibrate.board.spec import BoardSpec, charuco_board
from brushloop.calibrate.board.view import drift, preflight, see_board_and_lens
from brushloop.calibrate.errors import CalibrationError

SPEC = BoardSpec(squares=(9, 7), square_mm=20.0, marker_mm=14.0, dictionary="DICT_5X5_100", origin_mm=(-10.0, 5.0))
HOUR_NS = 3_600_000_000_000


def photograph(scale: float = 1.0, shift_px: float = 0.0, noise: float = 1.5, seed: int = 0) -> np.ndarray:
    """The board at about 5 px/mm, seen at a slant."""
    picture = charuco_board(SPEC, "test").generateImage((9 * 160, 7 * 160))
    picture = cv2.copyMakeBorder(picture, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=240)
    slant = np.array([[0.62, 0.02, 30.0 + shift_px], [-0.01, 0.62, 40.0], [1e-5, 2e-5, 1.0]])
    about = np.array([[scale, 0.0, 500.0 * (1 - scale)], [0.0, scale, 400.0 * (1 - scale)], [0.0, 0.0, 1.0]])
    image = cv2.warpPerspective(picture, about @ slant, (1024, 800), flags=cv2.INTER_AREA, borderValue=120)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.9) + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(noisy, 0, 235).astype(np.uint8)


def test_a_camera_that_stays_has_no_trend_and_no_warning() -> None:
    found = drift([(k * HOUR_NS, photograph(seed=k)) for k in range(4)], SPEC)
    assert len(found.seen) == 4
    assert max(seen.moved_px for seen in found.seen) < 0.1
    assert found.trend is not None
    assert abs(found.trend.slope) < 1e-4
    assert found.warnings == ()


def test_a_camera_that_sinks_or_was_touched_is_reported() -> None:
    stills = [(k * HOUR_NS, photograph(1.0 + 0.001 * k, seed=k)) for k in range(4)]
    sinking = drift([*stills, (5 * HOUR_NS, np.full((800, 1024), 200, np.uint8))], SPEC)
    assert sinking.trend is not None
    assert sinking.trend.slope == pytest.approx(-0.001, rel=0.1)
    assert any("pix2len changed by -0.2" in line for line in sinking.warnings)
    assert any("the board is not seen" in line and "blank" in line for line in sinking.warnings)
    touched = drift([(0, photograph()), (HOUR_NS, photograph(shift_px=4.0))], SPEC)
    assert any("the board moved by" in line for line in touched.warnings)


def test_a_sound_board_passes_and_its_interval_is_narrow() -> None:
    plane, warnings = preflight(photograph(), SPEC)
    assert warnings == ()
    low, high = plane.interval_mm_per_px
    assert low < plane.mm_per_px < high
    assert high - low < 1e-3 * plane.mm_per_px
    points = np.array([[0.0, 20.0], [150.0, 120.0]])
    assert plane.to_paper(plane.to_image(points)) == pytest.approx(points, abs=1e-6)


def test_what_is_wrong_with_a_view_is_said_before_the_session() -> None:
    hidden = photograph()
    hidden[:, 420:] = 200
    _, warnings = preflight(hidden, SPEC)
    assert any("partly hidden" in line for line in warnings)
    small = cv2.resize(photograph(), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    assert any("px/mm, at least" in line for line in preflight(small, SPEC)[1])
    with pytest.raises(CalibrationError, match="is blank"):
        see_board_and_lens(np.full((800, 1024), 200, np.uint8), SPEC)
