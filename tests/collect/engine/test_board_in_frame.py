"""Where the paper lies in a photograph: the board is looked for once, however many steps ask."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.engine.steps import context
from brushloop.collect.engine.steps.context import RunContext
from brushloop.collect.errors import BadPicture


class Camera:
    """Frames, and the planes that are found in them."""

    def __init__(self, *planes: str | None) -> None:
        self.frames: list[Any] = [np.zeros((2, 2), np.uint8) for _ in planes]
        self.planes = planes
        self.searched: list[int] = []

    def see_board(self, image: Any, _spec: object) -> str:
        [number] = [k for k, frame in enumerate(self.frames) if frame is image]
        self.searched.append(number)
        if (plane := self.planes[number]) is None:
            raise CalibrationError("camera", "no board")
        return plane


def run_with(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> RunContext:
    monkeypatch.setattr(context, "see_board", camera.see_board)
    nothing: Any = SimpleNamespace()
    rig: Any = SimpleNamespace(config=SimpleNamespace(board=None))
    return RunContext(rig, nothing, nothing, nothing, nothing, nothing, nothing)


def test_a_frame_is_searched_once_for_being_judged_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera("first", "second")
    run = run_with(camera, monkeypatch)
    assert [run.image_plane(camera.frames[k]) for k in (0, 0, 1, 1)] == ["first", "first", "second", "second"]
    assert camera.searched == [0, 1]


def test_a_hidden_board_is_taken_from_the_newest_frame_that_showed_one(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(None, "seen", None)
    run = run_with(camera, monkeypatch)
    with pytest.raises(BadPicture, match="no board"):
        run.image_plane(camera.frames[0])
    assert [run.image_plane(camera.frames[k]) for k in (1, 2, 2)] == ["seen"] * 3
    assert camera.searched == [0, 1, 2]
