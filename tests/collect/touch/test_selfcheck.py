"""The self-check: a good rig passes, a mirrored, turned, stretched or displaced one is described in words."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import AsyncMock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import PaperConfig, SelfCheckConfig
from brushloop.collect.rig.paper import Sheet, to_base
from brushloop.collect.touch.selfcheck import LEGS_MM, Triangle, judge, partners, self_check, triangle_on
from brushloop.drivers.devices import Pose
from tests.collect.touch.bench import Bench

PLACES: Triangle = ((12.0, 8.0), (100.0, 8.0), (12.0, 68.0))
COMMANDED = np.array(PLACES)
MIDDLE = COMMANDED.mean(axis=0)
CONFIG = SelfCheckConfig()


def linear(*rows: tuple[float, float], about: NDArray[np.float64] = MIDDLE) -> NDArray[np.float64]:
    """The commanded marks after a linear map about a point."""
    return (COMMANDED - about) @ np.array(rows).T + about


def turn(deg: float) -> tuple[tuple[float, float], tuple[float, float]]:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return (c, -s), (s, c)


@given(order=st.permutations(range(3)), noise=st.integers(0, 10_000), turn_deg=st.floats(-0.5, 0.5))
def test_a_good_rig_passes_in_whatever_order_the_marks_are_found(order: list[int], noise: int, turn_deg: float) -> None:
    rng = np.random.default_rng(noise)
    found = linear(*turn(turn_deg)) + np.array([-1.2, 0.05]) + np.clip(rng.normal(0.0, 0.09, (3, 2)), -0.2, 0.2)
    check = judge(COMMANDED, found[order], CONFIG)
    assert np.array_equal(np.array(check.found_mm), found)
    assert check.turn_deg == pytest.approx(turn_deg, abs=0.4)
    assert max(check.residuals_mm) < 0.5


@pytest.mark.parametrize(
    ("found", "why"),
    [
        (linear((-1, 0), (0, 1)), "mirrored in x"),
        (linear((1, 0), (0, -1)), "mirrored in y"),
        (linear((0, 1), (1, 0)), "x and y are swapped"),
        (linear((0, -1), (-1, 0)), "swapped and negated"),
        (linear(*turn(1.5)), r"turned by \+1\.5"),
        (linear((1.02, 0), (0, 1.02)), r"\+2\.00 % along x and \+2\.00 % along y"),
        (linear((1, 0), (0, 0.98)), r"\+0\.00 % along x and -2\.00 % along y"),
        (COMMANDED + np.array([0.0, 4.0]), r"lie off by \(\+0\.00, \+4\.00\) mm"),
    ],
)
def test_a_rig_that_is_off_is_described(found: NDArray[np.float64], why: str) -> None:
    with pytest.raises(StepError, match=why):
        judge(COMMANDED, found[[2, 0, 1]], CONFIG)


@given(noise=st.integers(0, 10_000), turn_deg=st.floats(0.0, 360.0), flip=st.booleans())
def test_no_turn_passes_for_a_mirror_nor_a_mirror_for_a_turn(noise: int, turn_deg: float, flip: bool) -> None:
    rng = np.random.default_rng(noise)
    rotation = np.array(turn(turn_deg)) @ np.diag([-1.0 if flip else 1.0, 1.0])
    found = linear(*rotation.tolist()) + rng.normal(0.0, 0.1, (3, 2))
    if flip:
        with pytest.raises(StepError, match="the marks are mirrored"):
            judge(COMMANDED, found, CONFIG)
    elif 2.0 < turn_deg < 358.0:
        with pytest.raises(StepError, match="the marks are turned by"):
            judge(COMMANDED, found, CONFIG)


def paper(size_x_mm: float, size_y_mm: float) -> PaperConfig:
    return PaperConfig(origin_mm=(0.0, 0.0), touch_z_mm=120.0, size_mm=(size_x_mm, size_y_mm))


def test_a_sheet_with_room_is_checked_over_three_corners_and_a_small_one_in_one_patch() -> None:
    sheet = Sheet(paper(244.0, 172.0))
    first = sheet.patch(0)
    wide = partners(sheet, first, {0})
    assert [patch.index for patch in wide] == [5, 36]
    assert triangle_on((first, *wide)) == tuple(patch.anchor_mm for patch in (first, *wide))
    again = partners(sheet, sheet.patch(1), {0, 1, 5, 36})
    assert [patch.index for patch in again] == [4, 37], "a second attempt finds places of its own"
    assert partners(sheet, first, set(range(sheet.capacity)) - {1, 6}) == (), "what is left is too near"
    small = Sheet(paper(110.0, 80.0))
    assert partners(small, small.patch(0), set()) == ()
    assert np.ptp(triangle_on((small.patch(0),)), axis=0).tolist() == pytest.approx(LEGS_MM)


@given(width=st.floats(40.0, 600.0), height=st.floats(24.0, 600.0), used=st.sets(st.integers(0, 60)))
def test_a_wide_triangle_is_always_uneven_wide_and_on_free_patches(width: float, height: float, used: set[int]) -> None:
    sheet = Sheet(paper(width, height))
    patch = sheet.patch(0)
    if wide := partners(sheet, patch, used):
        assert not used & {one.index for one in wide}
        places = np.array(triangle_on((patch, *wide)))
        assert np.ptp(places, axis=0).min() >= 60.0
        mirrored = places * np.array([-1.0, 1.0])
        with pytest.raises(StepError, match="mirrored in x"):
            judge(places, mirrored, CONFIG)


Fault = Callable[[Bench], None]


def goes_to(change: Callable[[float, float], tuple[float, float]]) -> Fault:
    """An arm that goes to `change(x, y)` of the paper frame when (x, y) is asked for, over the sheet only."""

    def bend(bench: Bench) -> None:
        paper = bench.rig.config.paper
        width_mm, height_mm = paper.size_mm

        def bent(pose: Pose) -> Pose:
            x, y = bench.world.config.table.to_paper(pose.x_mm, pose.y_mm)
            if not (0.0 <= x <= width_mm and 0.0 <= y <= height_mm):
                return pose
            base_x, base_y = to_base(paper, *change(x, y))
            return replace(pose, x_mm=base_x, y_mm=base_y)

        bench.bent = bent

    return bend


def dry_brush(bench: Bench) -> None:
    bench.effector.dip = AsyncMock()


def mirrored_camera(bench: Bench) -> None:
    photograph = bench.photograph
    bench.photograph = lambda: np.ascontiguousarray(photograph()[:, ::-1])


def arm_in_the_second_picture(bench: Bench) -> None:
    photograph, shots = bench.photograph, itertools.count()

    def with_arm() -> NDArray[np.uint8]:
        image = photograph()
        return np.asarray(cv2.circle(image.copy(), (250, 550), 90, 70, -1) if next(shots) else image, np.uint8)

    bench.photograph = with_arm


def board_printed_too_small(bench: Bench) -> None:
    """By 2 %, or measured badly: every length by this camera is 2 % too large."""
    board = bench.rig.config.board
    wrong = board.model_copy(update={"square_mm": 1.02 * board.square_mm, "marker_mm": 1.02 * board.marker_mm})
    bench.rig = replace(bench.rig, config=bench.rig.config.model_copy(update={"board": wrong}))


CORNERS, ONE_PATCH = (0, 5, 36), (36,)


@pytest.mark.parametrize(
    ("fault", "patches", "why"),
    [
        (goes_to(lambda x, y: (244.0 - x, y)), CORNERS, "mirrored in x"),
        (goes_to(lambda x, y: (x + 3.0, y - 4.0)), CORNERS, "the marks lie off by"),
        (dry_brush, CORNERS, "3 marks were pressed, new marks seen: 0"),
        (mirrored_camera, CORNERS, "the board is not seen: the photograph is mirrored"),
        (arm_in_the_second_picture, CORNERS, r"mm2 at \(.*\) mm became dark, more than a mark: is the arm"),
        (board_printed_too_small, CORNERS, r"off by \+(1\.[7-9]|2\.[0-3]).* along x and \+(1\.[7-9]|2\.[0-3])"),
        (board_printed_too_small, ONE_PATCH, None),
    ],
)
async def test_what_is_wrong_at_the_rig_is_described_with_the_brush_lifted(
    tmp_path: Path, fault: Fault, patches: tuple[int, ...], why: str | None
) -> None:
    """Within one patch, a camera that is 2 % wrong is not seen."""
    bench = Bench(tmp_path, whole=True)
    sheet = Sheet(bench.rig.config.paper)
    fault(bench)
    bench.effector.rig, places = bench.rig, triangle_on([sheet.patch(index) for index in patches])
    with contextlib.nullcontext() if why is None else pytest.raises(StepError, match=why):
        await self_check(bench.effector, places, bench.effector.dip)
    assert bench.lifted
