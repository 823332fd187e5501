"""What the loopback camera sees, and when its pictures are sent."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import cv2
import numpy as np
import pytest

from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.scene import Line, Scene, board, homography
from brushloop.drivers.sim.world import World

CONFIG = SimConfig(view=View(width_px=1024, height_px=768, px_per_mm=3.125))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(World(CONFIG))


def pixel(x_mm: float, y_mm: float) -> tuple[int, int]:
    """(column, row) of a point of the paper frame."""
    u, v, w = homography(CONFIG.view) @ np.array([x_mm, y_mm, 1.0])
    return round(u / w), round(v / w)


def gray_at(image: np.ndarray, x_mm: float, y_mm: float) -> float:
    column, row = pixel(x_mm, y_mm)
    return float(image[row - 3 : row + 4, column - 3 : column + 4].mean())


@pytest.mark.parametrize("view", [CONFIG.view, View(k1=-0.08)], ids=["a lens without distortion", "with"])
def test_corners_of_the_board_lie_where_the_optics_say(view: View):
    table, scene = CONFIG.table, Scene(World(SimConfig(view=view)))
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board(table)).detectBoard(scene.render())
    on_board = np.asarray(board(table).getChessboardCorners())[ids.ravel(), :2]
    left, bottom = table.board_origin_mm
    height_mm = table.board_squares[1] * table.board_square_mm
    paper_mm = np.column_stack([left + on_board[:, 0], bottom + height_mm - on_board[:, 1]]).astype(np.float64)
    off_px = corners.reshape(-1, 2) - scene.optics.image_of(paper_mm)
    assert len(ids) > 100
    assert np.quantile(np.linalg.norm(off_px, axis=1), 0.95) < 0.8
    # Blur rounds the corners of black squares, by turns to either side; the mean shows a wrong half pixel.
    assert np.abs(np.mean(off_px, axis=0)).max() < 0.1


def test_noise_is_new_in_every_frame(scene: Scene):
    assert not np.array_equal(scene.render(), scene.render())


def test_ink_shows_in_the_very_next_frame():
    world = World(CONFIG)
    scene = Scene(world)
    before = gray_at(scene.render(), 60.0, 60.0)
    world.paper.density = np.ones_like(world.paper.density)
    world.version += 1
    assert gray_at(scene.render(), 60.0, 60.0) < 0.3 * before


def test_the_arm_hides_what_is_under_it():
    table = CONFIG.table
    assert table.yaw_deg == 90.0
    home = (table.origin_mm[0] - 74.0, table.origin_mm[1] + 82.0, 260.0)  # over (82, 74) of the sheet
    image = Scene(World(replace(CONFIG, home_mm=home))).render()
    assert gray_at(image, 82.0, 74.0) == pytest.approx(70.0, abs=3.0)


def test_a_frame_rendered_for_a_known_tool_leaves_the_world_alone(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    tool = scene.tool()

    def nobody_may_ask(_: World) -> None:
        raise AssertionError("the world was moved on from the rendering thread")

    monkeypatch.setattr(World, "tool", nobody_may_ask)
    scene.render(tool)


class Loop:
    """A clock that stands still, and what is due on it."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.due_s: list[float] = []

    def time(self) -> float:
        return self.now_s

    def call_at(self, when_s: float, _call: Callable[..., None], _data: bytes) -> None:
        self.due_s.append(when_s)


class Open:
    """A connection; its client has taken everything once `taken` is set."""

    def __init__(self) -> None:
        self.taken = asyncio.Event()
        self.taken.set()

    def is_closing(self) -> bool:
        return False

    async def drain(self) -> None:
        await self.taken.wait()


async def test_the_time_to_draw_a_picture_is_a_part_of_its_delay_and_no_picture_overtakes_another() -> None:
    loop, line = Loop(), Line(View(delay_s=0.3, delay_jitter_s=0.0), cast("asyncio.StreamWriter", Open()))
    line._loop = cast("asyncio.AbstractEventLoop", loop)
    line._last_s = loop.now_s
    for drawn_s in (0.05, 0.0, 2.0, 0.0):
        exposed_s = loop.now_s
        loop.now_s += drawn_s
        await line.send(b"picture", exposed_s)
    assert loop.due_s == pytest.approx([100.3, 100.35, 100.35, 102.35], abs=1e-3)
    assert loop.due_s == sorted(set(loop.due_s))


async def test_a_client_that_reads_too_slowly_is_sent_no_further_picture_until_it_has_taken_the_earlier_ones() -> None:
    client = Open()
    client.taken.clear()
    line = Line(View(delay_s=0.3), cast("asyncio.StreamWriter", client))
    sending = asyncio.create_task(line.send(b"picture", 0.0))
    await asyncio.sleep(0)
    assert not sending.done()
    client.taken.set()
    await sending
