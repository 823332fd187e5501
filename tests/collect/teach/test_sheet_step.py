"""Corners of the sheet that were not touched."""

from __future__ import annotations

import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.teach.steps.sheet import BOARD, all_corners
from brushloop.collect.teach.store import Notebook, Taught, Value, now_utc, touch_of
from brushloop.drivers.geometry import brush_pose

BOARD_MM = {"lower left": (0.0, 0.0), "lower right": (0.0, -312.0), "upper left": (240.0, 0.0)}
"""From its lower left corner along the base axes: the board is turned by -90 deg."""


def taught(value: Value) -> Taught:
    return Taught(value=value, how="typed", at=now_utc(), step="tip")


def touched_from(x_mm: float, y_mm: float) -> Notebook:
    """All corners but the upper right one, the lower left one at (x, y)."""
    notebook = Notebook().with_values(
        {
            "robot.tcp_offset_mm": taught([0.0, 0.0, 180.0]),
            "board.squares": taught([26, 20]),
            "board.square_mm": taught(12.0),
            "board.marker_mm": taught(9.0),
            "board.dictionary": taught("DICT_5X5_1000"),
        }
    )
    for corner, (x, y) in BOARD_MM.items():
        notebook = notebook.with_touch(f"{BOARD} 0 {corner}", touch_of(brush_pose(x_mm + x, y_mm + y, 300.0)))
    return notebook


@pytest.mark.parametrize(
    ("lower_left_mm", "way_out"),
    [
        ((560.0, 312.0), "by 100 mm nearer to its foot, from which that corner is 800 mm,"),
        ((-440.0, 312.0), "by 50 mm away from its foot, to which that corner is too near,"),
        ((200.0, 312.0), "nearer to it, or turn its wrist the other way round,"),
    ],
)
def test_a_corner_that_the_arm_does_not_reach_is_named_with_how_far_to_move_the_board(
    lower_left_mm: tuple[float, float], way_out: str
) -> None:
    with pytest.raises(CannotTeach) as refused:
        all_corners(touched_from(*lower_left_mm), BOARD, "board")
    assert refused.value.what == "not touched: board upper right."
    assert f"move the board with the sheet {way_out} and touch all corners again" in refused.value.way_out
