from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.camera.scene import NOISE_FIELDS, PAPER_GRAY, TOOL_GRAY, Scene, board, homography, read_strip
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.world import World

CONFIG = SimConfig(view=View(width_px=1024, height_px=768, px_per_mm=3.125))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(World(CONFIG))


@pytest.fixture(scope="module")
def image(scene: Scene) -> np.ndarray:
    return scene.render()


def pixel(x_mm: float, y_mm: float) -> tuple[int, int]:
    """(column, row) of a point of the paper frame."""
    u, v, w = homography(CONFIG.view) @ np.array([x_mm, y_mm, 1.0])
    return round(u / w), round(v / w)


def gray_at(image: np.ndarray, x_mm: float, y_mm: float) -> float:
    column, row = pixel(x_mm, y_mm)
    return float(image[row - 3 : row + 4, column - 3 : column + 4].mean())


def test_an_image_has_the_size_of_the_view(image: np.ndarray):
    assert image.shape == (768, 1024)
    assert image.dtype == np.uint8


def test_the_sheet_is_bright_in_all_its_corners(image: np.ndarray):
    size_x_mm, size_y_mm = CONFIG.table.sheet_mm
    for corner in itertools.product((3.0, size_x_mm - 3.0), (3.0, size_y_mm - 3.0)):
        assert gray_at(image, *corner) > 0.7 * PAPER_GRAY


def beside_the_sheet(x_mm: float, y_mm: float, by_mm: float) -> bool:
    size_x_mm, size_y_mm = CONFIG.table.sheet_mm
    return not (-by_mm < x_mm < size_x_mm + by_mm and -by_mm < y_mm < size_y_mm + by_mm)


def test_every_corner_of_the_board_that_the_sheet_leaves_bare_is_found_where_it_lies(image: np.ndarray):
    table = CONFIG.table
    found, ids, _, _ = cv2.aruco.CharucoDetector(board(table)).detectBoard(image)
    at = dict(zip(ids.ravel().tolist(), found.reshape(-1, 2), strict=True))
    columns, rows = (n - 1 for n in table.board_squares)
    off_px: list[np.ndarray] = []
    for ident in range(columns * rows):
        row, column = divmod(ident, columns)  # counted from the upper left, row by row
        x_mm = table.board_origin_mm[0] + (column + 1) * table.board_square_mm
        y_mm = table.board_origin_mm[1] + (rows - row) * table.board_square_mm
        if beside_the_sheet(x_mm, y_mm, table.board_square_mm):
            assert ident in at
        if ident in at and beside_the_sheet(x_mm, y_mm, 1.0):
            u, v, w = homography(CONFIG.view) @ np.array([x_mm, y_mm, 1.0])
            off_px.append(at[ident] - np.array([u / w, v / w]))
    # Blur rounds the corners of black squares, by turns to either side; the mean shows a wrong half pixel.
    assert np.abs(off_px).max() < 0.8
    assert np.abs(np.mean(off_px, axis=0)).max() < 0.05


def test_one_millimetre_is_as_many_pixels_as_the_view_says():
    x, y = CONFIG.view.centre_mm
    h = homography(CONFIG.view)
    a, b = (h @ np.array([x + d, y, 1.0]) for d in (-0.5, 0.5))
    assert np.hypot(*(b / b[2] - a / a[2])[:2]) == pytest.approx(CONFIG.view.px_per_mm, rel=1e-3)


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


def test_a_frame_after_the_arm_has_left_is_as_if_it_had_never_been_there():
    over, away = brush_pose(380.0, 0.0, 180.0), brush_pose(*CONFIG.home_mm)
    passed, alone = Scene(World(CONFIG)), Scene(World(CONFIG))
    hidden = [passed.render(0, over) for _ in range(NOISE_FIELDS)]
    for under_arm in hidden:
        after, never = passed.render(0, away), alone.render(0, away)
        assert np.array_equal(after, never)
        # The arm hides a disc; every other pixel, its noise included, stays.
        assert 0.13 < np.mean(under_arm != never) < 0.15
        assert set(np.unique(under_arm[under_arm != never])) == {TOOL_GRAY}


@pytest.mark.parametrize("host_ns", [0, 1, 2**63 - 1, 0x5555555555555555, 1_795_000_000_123_456_789])
@pytest.mark.parametrize("quality", [60, 95])
def test_the_time_in_the_top_rows_survives_jpeg(small_view: View, host_ns: int, quality: int):
    scene = Scene(World(SimConfig(view=small_view)))
    _, encoded = cv2.imencode(".jpg", scene.render(host_ns), [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    assert read_strip(decoded) == host_ns


def test_a_frame_rendered_for_a_known_tool_leaves_the_world_alone(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    tool = scene.tool()

    def nobody_may_ask(_: World) -> None:
        raise AssertionError("the world was moved on from the rendering thread")

    monkeypatch.setattr(World, "tool", nobody_may_ask)
    scene.render(0, tool)
