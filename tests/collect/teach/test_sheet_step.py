"""Corners of the sheet that were not touched."""

from __future__ import annotations

import pytest

from collect.teach.errors import CannotTeach
from collect.teach.steps.sheet import BOARD, all_corners
from collect.teach.store import Notebook, Taught, now_utc, touch_of
from drivers.geometry import brush_pose


def test_a_corner_that_the_arm_does_not_reach_is_named_with_the_way_out() -> None:
    tool = Taught(value=[0.0, 0.0, 180.0], how="typed", at=now_utc(), step="tip")
    notebook = Notebook().with_values({"robot.tcp_offset_mm": tool})
    for corner in ("lower left", "lower right", "upper left"):
        notebook = notebook.with_touch(f"{BOARD} 0 {corner}", touch_of(brush_pose(400.0, 0.0, 300.0)))
    with pytest.raises(CannotTeach) as refused:
        all_corners(notebook, BOARD, "board")
    assert refused.value.what == "not touched: board upper right."
    assert "move the board with the sheet nearer" in refused.value.way_out
