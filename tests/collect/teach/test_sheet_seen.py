"""The sheet as the camera sees it on its board, against the sheet as it was touched."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.spec import BoardSpec, charuco_board, size_mm
from brushloop.collect.errors import CannotTeach
from brushloop.collect.teach.maths.sheet_seen import Margins, check_seen, seen_margins, touched_margins

SPEC = BoardSpec(squares=(26, 20), square_mm=12.0, marker_mm=9.0, origin_mm=(0.0, 0.0))
LAID = Margins(38.0, 27.0, 31.0, 35.0)
PX_PER_MM = 3.0


def photograph(laid: Margins) -> np.ndarray:
    """The board with a plain sheet on it, slanted as a camera beside it sees it, with noise."""
    width, height = size_mm(SPEC)
    size = (round(width * PX_PER_MM), round(height * PX_PER_MM))
    picture = charuco_board(SPEC, "").generateImage(size, marginSize=0)
    left, right = round(laid.left * PX_PER_MM), size[0] - round(laid.right * PX_PER_MM)
    upper, lower = round(laid.upper * PX_PER_MM), size[1] - round(laid.lower * PX_PER_MM)
    picture[upper:lower, left:right] = 240
    corners = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]], np.float32)
    seen_at = np.array([[90, 60], [1020, 40], [1060, 800], [60, 780]], np.float32)
    slanted = cv2.warpPerspective(picture, cv2.getPerspectiveTransform(corners, seen_at), (1120, 840), borderValue=150)
    noisy = cv2.GaussianBlur(slanted, (0, 0), 0.8) + np.random.default_rng(1).normal(0.0, 3.0, slanted.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def test_the_edges_of_the_sheet_are_seen_to_half_a_mm() -> None:
    picture = photograph(LAID)
    seen = seen_margins(picture, find_board(picture, SPEC, "camera"), SPEC, LAID)
    assert seen is not None
    assert seen.off_mm(LAID.left, LAID.right, LAID.lower, LAID.upper) < 0.5
    assert check_seen(seen, LAID) < 0.5


def test_margins_follow_from_the_touched_board_and_sheet() -> None:
    assert touched_margins((-38.0, -31.0), (247.0, 174.0), SPEC) == LAID


@pytest.mark.parametrize(
    ("named", "said"),
    [
        (Margins(27.0, 38.0, 35.0, 31.0), "turned by half a turn"),
        (Margins(27.0, 38.0, 31.0, 35.0), "left and right corners were taken for one another, as in a mirror"),
        (Margins(38.0, 27.0, 35.0, 31.0), "lower and upper corners were taken"),
        (Margins(33.0, 32.0, 31.0, 35.0), r"left 3[78]\.\d mm \(33\.0 touched\)"),
    ],
)
def test_a_sheet_that_was_named_or_touched_otherwise_is_recognised(named: Margins, said: str) -> None:
    picture = photograph(LAID)
    seen = seen_margins(picture, find_board(picture, SPEC, "camera"), SPEC, named)
    assert seen is not None
    with pytest.raises(CannotTeach, match=said) as refused:
        check_seen(seen, named)
    assert "touch" in refused.value.way_out.lower()


def test_a_board_without_a_sheet_has_no_edges_to_be_seen() -> None:
    bare = photograph(Margins(150.0, 150.0, 110.0, 110.0))
    assert seen_margins(bare, find_board(bare, SPEC, "camera"), SPEC, LAID) is None
