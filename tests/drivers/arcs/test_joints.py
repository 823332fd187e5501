"""Joint moves are checked along their whole way, by poses that the controller computes."""

from __future__ import annotations

import asyncio
import math

import pytest

from drivers.arcs import joints as joints_module
from drivers.arcs.robot import AuboArcs
from drivers.errors import DeviceError, LimitExceeded, MotionFailed, NotConnected, ProtocolViolation
from drivers.geometry import brush_pose, distance, to_wire
from drivers.samples import Pose
from drivers.sim.arcs.server import ArcsServer

GENTLE = {"speed_rad_s": 0.2, "acc_rad_s2": 0.8}
NEAR = brush_pose(300.0, -200.0, 240.0)


def joints_for(cabinet: ArcsServer, pose: Pose) -> list[float]:
    found, code = cabinet.cabinet.ik(list(cabinet.cabinet.joints()), to_wire(pose))
    assert code == 0
    return found


def untouched(cabinet: ArcsServer) -> bool:
    return cabinet._world.motion._next_id == 0


async def test_a_joint_move_returns_when_the_arm_rests_at_its_target(arm: AuboArcs, cabinet: ArcsServer):
    target = joints_for(cabinet, NEAR)
    for _ in range(2):  # the second time it is there already
        await arm.move_joint(target, **GENTLE)
        assert distance(cabinet._world.tool(), NEAR)[0] < 0.05
        assert cabinet.cabinet.joints() == pytest.approx(target, abs=1e-4)


async def test_joints_whose_tip_is_outside_the_box_are_refused_before_anything_moves(
    arm: AuboArcs, cabinet: ArcsServer
):
    for outside, field in ((brush_pose(300.0, -200.0, 60.0), "z"), (brush_pose(180.0, -230.0, 260.0), "x")):
        with pytest.raises(LimitExceeded) as caught:
            await arm.move_joint(joints_for(cabinet, outside), **GENTLE)
        assert caught.value.field == field
    assert untouched(cabinet)


async def test_a_way_that_leaves_the_box_between_two_ends_inside_is_refused(arm: AuboArcs, cabinet: ArcsServer):
    q = list(cabinet.cabinet.joints())
    target = joints_for(cabinet, brush_pose(250.0, 230.0, 260.0))
    target[0] += 2 * math.pi if target[0] < q[0] else -2 * math.pi  # the long way round, behind the base
    with pytest.raises(LimitExceeded) as caught:
        await arm.move_joint(target, **GENTLE)
    assert caught.value.field in ("x", "y")
    assert untouched(cabinet)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("speed", {"speed_rad_s": 2.0}),
        ("acceleration", {"acc_rad_s2": 20.0}),
        ("joint speed", {"speed_rad_s": 0.0}),
        ("joint speed", {"speed_rad_s": -1.0}),
        ("joint speed", {"speed_rad_s": math.nan}),
        ("joint speed", {"speed_rad_s": math.inf}),
        ("joint acceleration", {"acc_rad_s2": math.nan}),
    ],
)
async def test_a_joint_move_may_not_carry_the_tip_faster_than_allowed(
    arm: AuboArcs, cabinet: ArcsServer, field: str, change: dict[str, float]
):
    with pytest.raises(LimitExceeded) as caught:
        await arm.move_joint(joints_for(cabinet, NEAR), **{**GENTLE, **change})
    assert caught.value.field == field
    assert untouched(cabinet)


@pytest.mark.parametrize("joint", [math.nan, math.inf, 7.0])
async def test_a_joint_that_is_none_is_refused(arm: AuboArcs, cabinet: ArcsServer, joint: float):
    with pytest.raises(LimitExceeded, match="joint 3"):
        await arm.move_joint([0.0, 0.0, joint, 0.0, 0.0, 0.0], **GENTLE)
    with pytest.raises(ValueError, match="six joints"):
        await arm.move_joint([0.0] * 5, **GENTLE)
    assert untouched(cabinet)


async def test_before_the_tool_is_set_nothing_is_said_of_joints(sleeping_arm: AuboArcs):
    with pytest.raises(NotConnected, match="not enabled"):
        await sleeping_arm.move_joint([0.0] * 6, **GENTLE)
    with pytest.raises(NotConnected, match="not enabled"):
        await sleeping_arm.reachable(NEAR)


async def test_the_controller_is_asked_what_is_within_reach(arm: AuboArcs, cabinet: ArcsServer):
    assert await arm.reachable(NEAR) is True
    assert await arm.reachable(brush_pose(900.0, 0.0, 250.0)) is False
    assert untouched(cabinet)


@pytest.mark.parametrize("answer", [None, 5, [], [[0.0] * 6, 7], [[0.0] * 5, 0], ["x", 0], [[None] * 6, 0]])
async def test_a_controller_that_computes_nonsense_moves_nothing(arm: AuboArcs, cabinet: ArcsServer, answer: object):
    cabinet._methods["rob1.RobotAlgorithm.forwardKinematics"] = lambda _: answer
    with pytest.raises(ProtocolViolation):
        await arm.move_joint([0.0] * 6, **GENTLE)
    assert untouched(cabinet)


@pytest.mark.parametrize("answer", [None, [0.0] * 5, ["x"] * 6, [math.nan] * 6])
async def test_joints_that_are_none_move_nothing(arm: AuboArcs, cabinet: ArcsServer, answer: object):
    cabinet._methods["rob1.RobotState.getJointPositions"] = lambda _: answer
    for attempt in (arm.move_joint([0.0] * 6, **GENTLE), arm.reachable(NEAR)):
        with pytest.raises(DeviceError):
            await attempt
    assert untouched(cabinet)


async def test_a_stop_in_mid_joint_move_stops_it(arm: AuboArcs, cabinet: ArcsServer):
    target = joints_for(cabinet, brush_pose(350.0, -100.0, 240.0))
    move = asyncio.create_task(arm.move_joint(target, speed_rad_s=0.02, acc_rad_s2=0.8))
    await asyncio.sleep(0.3)
    await arm.stop()
    with pytest.raises(MotionFailed):
        await move
    assert cabinet._world.motion.exec_id(cabinet._now_s) == -1
    assert distance(cabinet._world.tool(), brush_pose(350.0, -100.0, 240.0))[0] > 20.0


def test_the_way_is_looked_at_closely_enough():
    assert joints_module.SAMPLE_RAD * 886.5 < 50.0  # mm between two samples with the arm stretched out
