"""What the arm promises, whoever answers: the loopback controller in either framing, or the arm of `--rig`.

Tests that power or move the arm are marked `moves`; each begins where the arm stands and brings it back there.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import itertools
import math
from collections.abc import AsyncIterator

import pytest

from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of, make_robot
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.devices import Pose, PoseSample, QueuedLine
from brushloop.drivers.errors import LimitExceeded, MotionError, NotConnected
from brushloop.drivers.geometry import distance
from brushloop.drivers.host import Clock
from tests.contract.conftest import ACC_MM_S2, LIFT_MM, SLOW_MM_S, SPEED_MM_S, Enabled, raised

GENTLY = {"speed_mm_s": SPEED_MM_S, "acc_mm_s2": ACC_MM_S2}
SLOWLY = {"speed_mm_s": SLOW_MM_S, "acc_mm_s2": ACC_MM_S2}
POSITION_MM, ROTATION_DEG = 0.05, 0.1
STILL_MM = 0.02
SAMPLES, LEAST_HZ = 40, 20.0


def assert_there(here: Pose, target: Pose) -> None:
    off_mm, off_deg = distance(here, target)
    assert off_mm <= POSITION_MM
    assert off_deg <= ROTATION_DEG


async def assert_still(robot: AuboArcs) -> Pose:
    """Where the arm rests; it must not creep away within a fifth of a second."""
    before = await robot.where()
    await asyncio.sleep(0.2)
    after = await robot.where()
    assert distance(before, after)[0] <= STILL_MM
    return after


@contextlib.asynccontextmanager
async def on_the_way_up(arm: Enabled) -> AsyncIterator[asyncio.Task[None]]:
    """A slow move that has risen by a tenth of its way; ended when the block ends."""
    moving = asyncio.Event()
    arm.robot.listen(lambda s: moving.set() if s.pose.z_mm > arm.start.z_mm + LIFT_MM / 10 else None)
    move = asyncio.create_task(arm.robot.follow([arm.top], **SLOWLY))
    try:
        async with asyncio.timeout(10.0):
            await moving.wait()
        yield move
    finally:
        arm.robot.listen(None)
        move.cancel()
        await asyncio.gather(move, return_exceptions=True)


async def test_telemetry_comes_often_and_in_order(arm: AuboArcs):
    samples: asyncio.Queue[PoseSample] = asyncio.Queue()
    arm.listen(samples.put_nowait)
    async with asyncio.timeout(SAMPLES / LEAST_HZ):
        taken = [await samples.get() for _ in range(SAMPLES)]
    arm.listen(None)
    assert all(b.stamp.seq == a.stamp.seq + 1 for a, b in itertools.pairwise(taken))
    assert all(b.stamp.host_ns > a.stamp.host_ns for a, b in itertools.pairwise(taken))


async def test_a_target_out_of_limits_is_refused_before_anything_is_sent(
    rig: RigConfig, arm: AuboArcs, monkeypatch: pytest.MonkeyPatch
):
    limits = limits_of(rig)
    axes = {axis: getattr(limits, axis) for axis in ("x_mm", "y_mm", "z_mm")}
    inside = dataclasses.replace(await arm.where(), **{axis: sum(ends) / 2 for axis, ends in axes.items()})
    wrong = [(axis, side, SPEED_MM_S) for axis, (low, high) in axes.items() for side in (low - 1.0, high + 1.0)]
    wrong += [("x_mm", math.nan, SPEED_MM_S), ("speed", 0.0, limits.speed_mm_s + 1.0)]
    sent: list[str] = []
    call = RpcConnection.call

    async def seen(self: RpcConnection, method: str, params: dict[str, object] | None = None) -> object:
        sent.append(method)
        return await call(self, method, params)

    monkeypatch.setattr(RpcConnection, "call", seen)
    for field, value, speed_mm_s in wrong:
        target = inside if field == "speed" else dataclasses.replace(inside, **{field: value})
        with pytest.raises(LimitExceeded) as caught:
            await arm.follow([target], speed_mm_s=speed_mm_s, acc_mm_s2=ACC_MM_S2)
        assert caught.value.field in (field.removesuffix("_mm"), "tilt")
    assert not [method for method in sent if not method.rpartition(".")[2].startswith("get")], "more than questions"


async def test_connecting_says_who_answers_and_with_closing_leaves_the_arm_where_it_is(
    rig: RigConfig, the_only_driver: None
):
    poses: list[Pose] = []
    for _ in range(2):
        robot = make_robot(rig, Clock(), print)
        with pytest.raises(NotConnected):
            robot.latest()
        try:
            identity = await robot.connect()
            assert all((identity.model, identity.firmware))
            poses.append(await assert_still(robot))
            assert_there(robot.latest().pose, poses[-1])
        finally:
            await robot.close()
        with pytest.raises(NotConnected):
            await robot.where()
    assert distance(*poses)[0] <= STILL_MM


@pytest.mark.moves
async def test_an_enabled_arm_has_not_moved_and_is_as_it_was_left(enabled: Enabled):
    mode, _ = await enabled.robot.modes()
    assert mode == "Running"
    assert_there(await assert_still(enabled.robot), enabled.start)
    await enabled.robot.confirm()
    await enabled.robot.follow([enabled.top], **GENTLY)
    await enabled.robot.confirm()
    assert_there(await enabled.robot.take_up(), enabled.top)


@pytest.mark.moves
async def test_a_move_arrives(enabled: Enabled):
    for target in (raised(enabled.start, LIFT_MM / 2), enabled.top, enabled.start):
        await enabled.robot.follow([target], **GENTLY)
        assert_there(await assert_still(enabled.robot), target)


@pytest.mark.moves
async def test_a_stop_in_mid_move_stops_short_and_a_later_move_works(enabled: Enabled):
    async with on_the_way_up(enabled) as move:
        await enabled.robot.stop()
        stopped = await assert_still(enabled.robot)
        with pytest.raises(MotionError):
            await move
    risen_mm = stopped.z_mm - enabled.start.z_mm
    assert 0.0 < risen_mm < LIFT_MM - 10 * POSITION_MM
    await enabled.robot.follow([enabled.start], **GENTLY)
    assert_there(await enabled.robot.where(), enabled.start)


@pytest.mark.moves
async def test_a_move_that_is_cancelled_stops_the_arm(enabled: Enabled):
    async with on_the_way_up(enabled) as move:
        move.cancel()
        with pytest.raises(asyncio.CancelledError):
            await move
        stopped = await assert_still(enabled.robot)
    assert stopped.z_mm - enabled.start.z_mm < LIFT_MM - 10 * POSITION_MM


@pytest.mark.moves
async def test_an_idle_arm_is_at_once_where_it_stands_and_a_stop_is_harmless_also_twice(enabled: Enabled):
    async with asyncio.timeout(1.0):
        await enabled.robot.follow([enabled.start], **GENTLY)
    await enabled.robot.stop()
    await enabled.robot.stop()
    await asyncio.gather(enabled.robot.stop(), enabled.robot.stop())
    assert_there(await assert_still(enabled.robot), enabled.start)
    await enabled.robot.follow([raised(enabled.start, LIFT_MM / 2)], **GENTLY)


@pytest.mark.moves
async def test_lines_that_are_handed_over_as_one_are_carried_out_with_their_dwell(enabled: Enabled):
    """Whether a cabinet takes lines while it holds its path, and lets a short line last, shows here first."""
    middle, dwell_s = LIFT_MM / 2, 1.0
    lines = [
        QueuedLine(raised(enabled.start, middle), SPEED_MM_S),
        QueuedLine(raised(enabled.start, middle + 0.05), SPEED_MM_S, dwell_s),
        QueuedLine(enabled.top, SPEED_MM_S),
    ]
    seen = await enabled.robot.sequence(lines, acc_mm_s2=ACC_MM_S2)
    assert_there(await assert_still(enabled.robot), enabled.top)
    assert any(abs(pose.z_mm - enabled.start.z_mm - middle) < 0.1 for pose in seen)


@pytest.mark.moves
async def test_closing_in_mid_move_leaves_no_motion(rig: RigConfig, enabled: Enabled):
    async with on_the_way_up(enabled):
        await enabled.robot.close()
    other = make_robot(rig, Clock(), print)
    try:
        await other.connect()
        stopped = await assert_still(other)
    finally:
        await other.close()
    assert stopped.z_mm - enabled.start.z_mm < LIFT_MM - 10 * POSITION_MM
    # Again, so that it can be brought back.
    await enabled.robot.connect()
    await enabled.robot.enable()
