"""The self-check: a good rig passes, a mirrored, turned, stretched or displaced one is told in words."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from collect.errors import StepError
from collect.plane import PaperPlane
from collect.sheet import Sheet, to_base
from collect.touch.config import SelfCheckConfig
from collect.touch.selfcheck import SelfCheck, Triangle, judge, self_check, triangle_in, triangle_of
from drivers.samples import Pose

if TYPE_CHECKING:
    from conftest import Bench, MakeBench

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
    assert np.array_equal(check.found_mm, found)
    assert check.turn_deg == pytest.approx(turn_deg, abs=0.4)
    assert max(check.residuals_mm) < 0.5


@pytest.mark.parametrize(
    ("found", "why"),
    [
        (linear((-1, 0), (0, 1)), "mirrored in x"),
        (linear((1, 0), (0, -1)), "mirrored in y"),
        (linear((0, 1), (1, 0)), "x and y are swapped"),
        (linear((0, -1), (-1, 0)), "swapped and negated"),
        (linear(*turn(180.0)), r"turned by [+-]180"),
        (linear(*turn(90.0)), r"turned by \+90"),
        (linear(*turn(1.5)), r"turned by \+1\.5"),
        (linear((1.02, 0), (0, 1.02)), r"\+2\.00 % along x and \+2\.00 % along y"),
        (linear((1, 0), (0, 0.98)), r"\+0\.00 % along x and -2\.00 % along y"),
        (COMMANDED + np.array([0.0, 4.0]), r"lie off by \(\+0\.00, \+4\.00\) mm"),
    ],
)
def test_a_rig_that_is_off_is_told_how(found: NDArray[np.float64], why: str) -> None:
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


async def checked(bench: Bench, places: Triangle = PLACES) -> SelfCheck:
    return await self_check(bench.rig, bench.hands, CONFIG, places, PaperPlane(120.0))


async def test_marks_on_the_loopback_sheet_are_found_and_pass(make_bench: MakeBench) -> None:
    bench = make_bench()
    check = await checked(bench)
    assert max(check.residuals_mm) < 0.4
    assert check.scale == pytest.approx((1.0, 1.0), abs=0.006)
    assert math.hypot(*check.offset_mm) < 2.0
    assert json.loads(json.dumps(check.as_dict()))["residuals_mm"] == list(check.residuals_mm)
    assert bench.lifted


async def test_old_ink_on_the_sheet_does_not_matter(make_bench: MakeBench) -> None:
    bench = make_bench()
    await checked(bench, ((30.0, 20.0), (90.0, 20.0), (30.0, 60.0)))
    await checked(bench)


def in_paper(bench: Bench, change: Any) -> Any:
    """An arm that goes to `change(x, y)` of the paper frame when (x, y) is asked for, over the sheet only."""

    def bent(pose: Pose) -> Pose:
        x, y = bench.world.to_paper(pose.x_mm, pose.y_mm)
        if not (0.0 <= x <= 110.0 and 0.0 <= y <= 80.0):
            return pose
        base_x, base_y = to_base(bench.rig.config.paper, *change(x, y))
        return replace(pose, x_mm=base_x, y_mm=base_y)

    return bent


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda x, y: (110.0 - x, y), "mirrored in x"),
        (lambda x, y: (x, 80.0 - y), "mirrored in y"),
        (lambda x, y: (y + 10.0, x - 20.0 if x > 50.0 else x), "3 marks|swapped|mirrored"),
        (lambda x, y: (1.02 * x, 1.02 * y), r"lengths are off by \+(1\.[5-9]|2\.\d).* along x"),
        (lambda x, y: (x + 3.0, y - 4.0), "the marks lie off by"),
    ],
    ids=["mirrored x", "mirrored y", "folded", "2 % too large", "displaced"],
)
async def test_an_arm_that_goes_elsewhere_is_refused(make_bench: MakeBench, change: Any, why: str) -> None:
    bench = make_bench()
    bench.bent = in_paper(bench, change)
    with pytest.raises(StepError, match=why):
        await checked(bench)
    assert bench.lifted


async def test_swapped_axes_are_refused(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.bent = in_paper(bench, lambda x, y: (y, x))
    with pytest.raises(StepError, match="x and y are swapped"):
        await checked(bench, ((12.0, 8.0), (75.0, 8.0), (12.0, 50.0)))


async def test_a_dry_brush_leaves_no_marks(make_bench: MakeBench) -> None:
    bench = make_bench()

    async def no_ink() -> None:
        return

    bench.hands.dip = no_ink  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(StepError, match="3 marks were pressed, 0 new ones are seen"):
        await checked(bench)


async def test_an_even_triangle_is_refused_before_anything_moves(make_bench: MakeBench) -> None:
    bench = make_bench()
    at = bench.target
    for places in (((10.0, 10.0), (60.0, 10.0), (10.0, 60.0)), ((10.0, 10.0), (60.0, 10.0), (100.0, 10.0))):
        with pytest.raises(StepError, match="too even, or too flat"):
            await checked(bench, places)
    assert bench.target == at


def test_triangles_lie_in_one_cell_or_over_three(make_bench: MakeBench) -> None:
    sheet = Sheet(make_bench().rig.config.paper)
    cell = sheet.cell(0)
    for x, y in triangle_in(cell, CONFIG):
        assert cell.x_mm <= x <= cell.x_mm + cell.width_mm
        assert cell.y_mm <= y <= cell.y_mm + cell.height_mm
    corners = (sheet.cell(0), sheet.cell(sheet.columns - 1), sheet.cell(sheet.capacity - sheet.columns))
    assert triangle_of(corners) == tuple(cell.anchor_mm for cell in corners)
