"""Zero touch on the loopback world: sheets that lean, what is refused, patches used up; no touch leaves its plan. And
the self-check: a good rig passes, a mirrored, turned, stretched or displaced one is described in words."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from brushloop.collect.errors import ConfigError, NeedsOperator, StepError
from brushloop.collect.operator import Asker, Prompt
from brushloop.collect.protocols.steps import SelfCheckStep, ZeroTouchStep
from brushloop.collect.rig.config import PaperConfig, SelfCheckConfig, TouchConfig
from brushloop.collect.rig.paper import PaperPlane, Sheet, to_base
from brushloop.collect.touch import camera
from brushloop.collect.touch.heights import Touch, at_one_point, plane_of
from brushloop.collect.touch.measure import measure_plane, used_patches
from brushloop.collect.touch.selfcheck import LEGS_MM, Triangle, judge, partners, self_check, triangle_on
from brushloop.collect.walk import check_poses, moves_of, step_poses
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import MotionFailed
from brushloop.sessions.events import ZeroTouchResult
from tests.collect.sent import not_checked, not_sent
from tests.collect.touch.bench import Bench

CORNERS = [(0.0, 0.0), (110.0, 0.0), (0.0, 80.0), (110.0, 80.0)]
THREE: dict[str, Any] = {"points_mm": [(6.0, 4.0), (104.0, 4.0), (50.0, 76.0)]}
PATCHES: dict[str, Any] = {"points_mm": [(4.0, 4.0), (70.0, 4.0), (36.0, 40.0)]}
NOBODY = Asker(watched=False)


async def measured(bench: Bench, asker: Asker = NOBODY, **touch: Any) -> ZeroTouchResult:
    config = TouchConfig.model_validate(touch)
    average, dip = bench.average, bench.dip
    return await measure_plane(bench.effector, config, dip=dip, average=average, asker=asker, tell=lambda _: None)


@pytest.mark.parametrize(
    ("method", "slope_deg", "most_mm"),
    [
        *(("force", slope_deg, 0.1) for slope_deg in [(0.0, 0.0), (1.0, 0.0), (0.0, -1.0), (-0.7, 0.7)]),
        ("jog", (0.5, 0.5), 0.021),
    ],
)
async def test_the_plane_of_a_leaning_sheet_is_found(
    tmp_path: Path, method: str, slope_deg: tuple[float, float], most_mm: float
) -> None:
    bench = Bench(tmp_path, slope_deg, paper_z_mm=119.6)
    result = await measured(bench, Operator(bench), method=method, **THREE)
    for point in result.points:
        truth_mm = bench.truth_mm(point.x_mm, point.y_mm)
        assert all(abs(z_mm - truth_mm) < most_mm for z_mm in point.touches_mm)
    for x, y in CORNERS:
        assert plane_of(result).touch_z_mm(x, y) == pytest.approx(bench.truth_mm(x, y), abs=0.06)
    assert result.slope_deg == pytest.approx(math.hypot(*slope_deg), abs=0.05)
    assert bench.lifted


@pytest.mark.parametrize(
    "sheets", [1, pytest.param(18, marks=[pytest.mark.soak, pytest.mark.timeout(300)], id="more than 200 touches")]
)
async def test_touches_by_camera_lie_within_150_um_of_the_truth_at_3_sigma(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sheets: int
) -> None:
    rng, errors, touches = np.random.default_rng(0), list[float](), list[Touch]()
    monkeypatch.setattr(
        camera, "at_one_point", lambda point, *rest: (touches.extend(point), at_one_point(point, *rest))[1]
    )
    for seed in range(sheets):
        towards = rng.uniform(0.0, 2.0 * math.pi)
        lean_deg = 1.0 if seed % 2 else rng.uniform(0.0, 1.0)
        slope_deg = (lean_deg * math.cos(towards), lean_deg * math.sin(towards))
        bench = Bench(tmp_path, slope_deg, paper_z_mm=120.0 + rng.uniform(-1.5, 1.5), seed=seed)
        places = [(2.0, 2.0), (76.0, 2.0), (39.0, 31.0)]
        touches.clear()
        await measured(bench, method="camera", touches=4, points_mm=places)
        errors += [touch.z_mm - bench.truth_mm(touch.x_mm, touch.y_mm) for touch in touches]
    assert len(errors) == 12 * sheets
    assert abs(float(np.mean(errors))) + 3.0 * float(np.std(errors)) < 0.15
    assert abs(float(np.mean(errors))) < 0.03


@pytest.mark.parametrize(
    ("touch", "paper_z_mm", "said"),
    [
        ({"method": "force"}, 117.5, "no contact was found down to"),
        ({"method": "camera"}, 115.5, "no touch of the row, down to"),
        (
            {"method": "camera", "points_mm": [(90.0, 4.0), (4.0, 4.0), (4.0, 40.0)]},
            120.0,
            r"do not fit on the sheet: spot \d+ would lie at",
        ),
    ],
)
async def test_what_cannot_be_touched_ends_with_the_brush_lifted(
    tmp_path: Path, touch: dict[str, Any], paper_z_mm: float, said: str
) -> None:
    bench = Bench(tmp_path, paper_z_mm=paper_z_mm)
    with pytest.raises(StepError, match=said):
        await measured(bench, **(PATCHES | touch))
    assert bench.lifted
    assert not bench.world.presses


async def test_a_bump_under_the_sheet_is_refused(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    four = [*THREE["points_mm"], (104.0, 76.0)]

    def lower_over_the_bump(pose: Pose) -> Pose:
        away_mm = math.dist(bench.world.config.table.to_paper(pose.x_mm, pose.y_mm), four[-1])
        return replace(pose, z_mm=pose.z_mm - 1.5) if away_mm < 10.0 else pose

    bench.bent = lower_over_the_bump
    with pytest.raises(StepError, match="do not lie in a plane: residuals"):
        await measured(bench, method="force", touches=1, points_mm=four, force={"sigma_mm": 0.05})
    assert bench.lifted


@pytest.mark.parametrize(
    "error", [asyncio.CancelledError(), MotionFailed("robot", "moveLine", "rests 0.40 mm and 0.00 deg from the target")]
)
async def test_an_arm_that_was_stopped_or_failed_is_left_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    bench = Bench(tmp_path)
    follow = bench.follow

    async def held_up(poses: list[Pose], *, speed_mm_s: float, acc_mm_s2: float) -> None:
        await follow(poses, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)
        if poses[-1].z_mm < 121.0:
            raise error

    monkeypatch.setattr(bench, "follow", held_up)
    with pytest.raises(type(error)):
        await measured(bench, method="force")
    assert not bench.lifted


class Operator(Asker):
    """Jogs down in large steps, then smaller ones, until the tip touches; or until it goes no lower, and then says
    `at_the_end`."""

    def __init__(self, bench: Bench, at_the_end: str = "") -> None:
        super().__init__(watched=True)
        self._bench = bench
        self._at_the_end = at_the_end
        self.questions: list[str] = []

    async def ask(self, prompt: Prompt) -> str:
        self.questions.append(prompt.question)
        if self._at_the_end:
            return self._at_the_end if "goes no lower" in prompt.question else "1"
        gap_mm = -self._bench.world.on_sheet(self._bench.target)[2]
        return next((key for key, step in (("1", 1.0), ("2", 0.1), ("3", 0.02)) if gap_mm > step), "t")


async def test_a_jog_ends_at_the_travel_limit_and_says_so(tmp_path: Path) -> None:
    bench = Bench(tmp_path, paper_z_mm=110.0)
    operator = Operator(bench, "x")
    with pytest.raises(NeedsOperator, match="touch 1 of 3"):
        await measured(bench, operator, method="jog")
    said = [("is -2.00 mm from" in question, "goes no lower" in question) for question in operator.questions]
    assert said[0] == (False, False)
    assert said[-1] == (True, True)
    assert all(lowest == told for lowest, told in said)
    assert bench.lifted


@pytest.mark.parametrize(
    ("sigma_mm", "second_mm", "repeats"),
    [(None, 0.14, True), (None, 0.16, False), (0.02, 0.16, False), (0.04, 0.19, True), (0.04, 0.21, False)],
)
def test_touches_may_span_the_limit_or_five_of_their_standard_errors(
    sigma_mm: float | None, second_mm: float, repeats: bool
) -> None:
    touches = [Touch(5.0, 5.0, 120.0, sigma_mm), Touch(5.0, 5.0, 120.0 + second_mm, sigma_mm)]
    if repeats:
        assert at_one_point(touches, TouchConfig(repeatability_mm=0.15)).span_mm == pytest.approx(second_mm)
    else:
        with pytest.raises(StepError, match="does not repeat"):
            at_one_point(touches, TouchConfig(repeatability_mm=0.15))


def test_patches_that_may_be_inked_are_used_up_and_those_beside_touches_in_the_margin_are_not() -> None:
    config = paper(244.0, 172.0).model_copy(update={"touch_point_mm": (2.0, 2.0)})
    sheet, corner = Sheet(config), Sheet(config).patch(36)
    margin = TouchConfig(method="force", points_mm=[(2.0, 2.0), (242.0, 2.0), (122.0, 170.0)])
    for touch in (TouchConfig(), margin):
        assert used_patches(sheet, config, touch) == set()
    points = [(corner.x_mm + 4.0, corner.y_mm + 9.0), (124.0, 6.0), (6.0, 100.0)]
    patches = used_patches(sheet, config, TouchConfig(method="camera", points_mm=points))
    assert {30, 36} <= patches, "its rows grow into the patch above"
    assert len(patches) < sheet.capacity / 3


TOUCH, CHECK = ZeroTouchStep(0), SelfCheckStep(0)
FEW, MANY = [(4.0, 4.0), (70.0, 4.0), (36.0, 36.0)], [*((x, 4.0) for x in (4.0, 36.0, 68.0, 100.0)), (4.0, 60.0)]


@pytest.mark.parametrize(
    ("method", "points_mm"), [*((method, FEW) for method in ("taught", "force", "jog", "camera")), ("jog", MANY)]
)
async def test_no_touch_leaves_what_was_checked(
    tmp_path: Path, method: str, points_mm: list[tuple[float, float]]
) -> None:
    """An operator jogs as low as the tip goes at each point: touches that each find the paper lower do not add up."""
    bench = Bench(tmp_path, (0.5, -0.5), paper_z_mm=119.4)
    touch: dict[str, Any] = {"method": method, "residual_mm": 9.0, "touches": 1, "points_mm": points_mm}
    config = bench.rig.config.model_copy(update={"touch": TouchConfig.model_validate(touch)})
    await measured(bench, Operator(bench, "t"), **touch)
    planned = moves_of(config, PaperPlane(config.paper.touch_z_mm), TOUCH)
    if method != "camera":  # whose spots of one patch lie beside each other
        beside = [(a, b) for a, b in pairwise(bench.sent) if math.hypot(b.x_mm - a.x_mm, b.y_mm - a.y_mm) > 1.0]
        assert all(here.z_mm >= config.motion.safe_z_mm for here, _ in beside), "it was lifted before it travelled"
    assert not not_checked(config, bench.sent, planned.segments)
    assert not not_sent(config, planned, bench.sent)
    lean_mm = 2.1  # of 1 deg over 116 mm
    assert min(pose.z_mm for pose in bench.sent) > 120.0 - config.touch.travel_mm - lean_mm


async def test_the_self_check_presses_as_deep_as_was_checked(tmp_path: Path) -> None:
    bench = Bench(tmp_path, whole=True)
    config, plane, sent = bench.rig.config, PaperPlane(120.0), bench.sent
    sheet = Sheet(config.paper)
    patches = (sheet.patch(0), *partners(sheet, sheet.patch(0), set()))
    await self_check(bench.effector, triangle_on(patches), bench.effector.dip)
    planned = moves_of(config, plane, CHECK, patches)
    assert not not_checked(config, sent, planned.segments)
    assert not not_sent(config, planned, sent)
    assert min(pose.z_mm for pose in sent) == 120.0 - config.self_check.depth_mm


def test_a_touch_that_the_operator_asks_for_by_key_is_checked_before_it(tmp_path: Path) -> None:
    """The rig visits a taught height near the arm; by jog it would touch where the arm may not go."""
    config = Bench(tmp_path).rig.config
    limits = config.robot.limits.model_copy(update={"y_mm": (config.robot.limits.y_mm[0], -20.0)})
    there = config.model_copy(
        update={
            "touch": TouchConfig(points_mm=[(100.0, 4.0)]),
            "robot": config.robot.model_copy(update={"limits": limits}),
        }
    )
    plane = PaperPlane(config.paper.touch_z_mm)
    check_poses(Path("rig.toml"), there, step_poses(there, plane, TOUCH))
    with pytest.raises(ConfigError, match=r"y = -10\.000 mm is outside .*zero_touch"):
        check_poses(Path("rig.toml"), there, step_poses(there, plane, replace(TOUCH, method="jog")))


# The self-check

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
    photograph, shots = bench.photograph, count()

    def with_arm() -> NDArray[np.uint8]:
        image = photograph()
        return np.asarray(cv2.circle(image.copy(), (250, 550), 90, 70, -1) if next(shots) else image, np.uint8)

    bench.photograph = with_arm


def board_printed_too_small(bench: Bench) -> None:
    """By 2 %, or measured badly: every length by this camera is 2 % too large."""
    board = bench.rig.config.board
    wrong = board.model_copy(update={"square_mm": 1.02 * board.square_mm, "marker_mm": 1.02 * board.marker_mm})
    bench.rig = replace(bench.rig, config=bench.rig.config.model_copy(update={"board": wrong}))


FAR_APART, ONE_PATCH = (0, 5, 36), (36,)


@pytest.mark.parametrize(
    ("fault", "patches", "why"),
    [
        (goes_to(lambda x, y: (244.0 - x, y)), FAR_APART, "mirrored in x"),
        (goes_to(lambda x, y: (x + 3.0, y - 4.0)), FAR_APART, "the marks lie off by"),
        (dry_brush, FAR_APART, "3 marks were pressed, new marks seen: 0"),
        (mirrored_camera, FAR_APART, "the board is not seen: the photograph is mirrored"),
        (arm_in_the_second_picture, FAR_APART, r"mm2 at \(.*\) mm became dark, more than a mark: is the arm"),
        (board_printed_too_small, FAR_APART, r"off by \+(1\.[7-9]|2\.[0-3]).* along x and \+(1\.[7-9]|2\.[0-3])"),
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
