"""A press that is queued as a whole: what another client, a lost host or an answer that nobody can read does to it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceTimeout,
    LimitExceeded,
    MotionFailed,
    MotionRefused,
    RobotNotSafe,
)
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from tests.drivers.failing import mute
from tests.waiting import PATIENCE_S

HOME = brush_pose(250.0, -230.0, 260.0)
TOP, DEEP = brush_pose(250.0, -230.0, 300.0), brush_pose(250.0, -230.0, 200.0)
DWELL_S = 4.0
PRESS = [QueuedLine(brush_pose(250.0, -230.0, 200.05), 40.0), QueuedLine(DEEP, 40.0, DWELL_S), QueuedLine(TOP, 40.0)]
ACC = 800.0
LINE, STOP_MOVE, START_MOVE = (f"rob1.MotionControl.{name}" for name in ("moveLine", "stopMove", "startMove"))


def z_mm(cabinet: ArcsServer) -> float:
    return cabinet.cabinet.world.tool().z_mm


def queued(cabinet: ArcsServer) -> int:
    cabinet.cabinet.world.motion.advance(cabinet.cabinet.now_s())
    return cabinet.cabinet.world.motion.size


def before_each(cabinet: ArcsServer, method: str, act: Callable[[int], object]) -> None:
    """Call `act` with the number of the request, from 1, before the controller carries it out."""
    carry_out, number = cabinet._methods[method], 0

    def noted(params: dict[str, Any]) -> Any:
        nonlocal number
        number += 1
        act(number)
        return carry_out(params)

    cabinet._methods[method] = noted


async def nothing_is_left(cabinet: ArcsServer) -> bool:
    """No line is queued, and none begins when somebody lets the path go on."""
    here = cabinet.cabinet.world.tool()
    cabinet.cabinet.resume()
    await asyncio.sleep(0.1)
    return queued(cabinet) == 0 and cabinet.cabinet.world.tool() == here


async def test_the_arm_goes_down_dwells_and_comes_up_and_the_lowest_pose_is_seen(arm: AuboArcs, cabinet: ArcsServer):
    seen = await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert distance(cabinet.cabinet.world.tool(), TOP)[0] <= 0.05
    assert min(pose.z_mm for pose in seen) == pytest.approx(200.0, abs=0.05)
    near, deep, top = list(cabinet.cabinet.world.motion.rests)[-3:]
    assert (near.pose.z_mm, deep.pose.z_mm, top.pose.z_mm) == pytest.approx((200.05, 200.0, 300.0))
    assert deep.at_s - near.at_s == pytest.approx(DWELL_S)


async def test_nothing_moves_before_the_controller_has_every_line(arm: AuboArcs, cabinet: ArcsServer):
    heights: list[float] = []
    before_each(cabinet, LINE, lambda _: heights.append(z_mm(cabinet)))
    held: list[int] = []
    before_each(cabinet, START_MOVE, lambda _: held.append(queued(cabinet)))
    await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert heights == [HOME.z_mm] * 3
    assert held == [3]


async def test_a_host_that_is_gone_once_the_path_was_let_go_is_not_needed(arm: AuboArcs, cabinet: ArcsServer):
    lowest: list[float] = []
    cabinet.cabinet.world.motion._on_path = lambda a, b: lowest.append(min(a.z_mm, b.z_mm))
    task = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    while z_mm(cabinet) > 250.0:
        await asyncio.sleep(0.002)
    for controller in (arm._motion, arm._stop, arm._state):
        writer = controller.connection._writer
        assert writer is not None
        writer.transport.abort()
    mute(cabinet)
    async with asyncio.timeout(10.0):
        while queued(cabinet):
            await asyncio.sleep(0.01)
    assert z_mm(cabinet) == pytest.approx(TOP.z_mm)
    assert min(lowest) == pytest.approx(DEEP.z_mm)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    cabinet.faults.clear()


@pytest.mark.parametrize("number", [1, 3])
async def test_a_connection_that_is_lost_before_the_path_is_let_go_leaves_the_arm_where_it_is(
    arm: AuboArcs, cabinet: ArcsServer, number: int
):
    def lose(now: int) -> None:
        writer = arm._motion.connection._writer
        if now == number and writer is not None:
            writer.transport.abort()

    before_each(cabinet, LINE, lose)
    with pytest.raises(ConnectionLost):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert z_mm(cabinet) == HOME.z_mm
    assert await nothing_is_left(cabinet)


@pytest.mark.parametrize("method", [STOP_MOVE, LINE, "rob1.MotionControl.getQueueSize"])
async def test_a_stop_before_the_path_is_let_go_drops_it(arm: AuboArcs, cabinet: ArcsServer, method: str):
    stops: list[asyncio.Task[None]] = []
    before_each(cabinet, method, lambda now: stops.append(asyncio.create_task(arm.stop())) if now == 1 else None)
    with pytest.raises(MotionFailed, match="was stopped"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    await asyncio.gather(*stops)
    assert z_mm(cabinet) == HOME.z_mm
    assert await nothing_is_left(cabinet)
    await arm.move(TOP, speed_mm_s=100.0, acc_mm_s2=ACC)  # the hold is over, too


@pytest.mark.parametrize("below_mm", [250.0, 200.1])
async def test_a_stop_on_the_way_down_or_at_depth_drops_the_lift(arm: AuboArcs, cabinet: ArcsServer, below_mm: float):
    task = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    while z_mm(cabinet) > below_mm:
        await asyncio.sleep(0.002)
    await arm.stop()
    with pytest.raises(MotionFailed):
        await task
    assert DEEP.z_mm <= z_mm(cabinet) <= below_mm
    assert await nothing_is_left(cabinet)


async def test_a_process_that_died_while_the_path_was_held_does_not_hold_up_the_next_one(
    arm: AuboArcs, cabinet: ArcsServer, arm_at: Callable[[int], AuboArcs]
):
    await arm.close()
    cabinet.cabinet.hold()  # and no further line was sent
    other = arm_at(cabinet.port)
    await other.connect()
    await other.enable()
    await other.move(TOP, speed_mm_s=100.0, acc_mm_s2=ACC)
    await other.close()
    assert z_mm(cabinet) == pytest.approx(TOP.z_mm)


async def test_lines_that_a_dead_process_left_held_are_dropped_even_if_no_line_counts_as_running(
    arm: AuboArcs, cabinet: ArcsServer, arm_at: Callable[[int], AuboArcs]
):
    await arm.close()
    cabinet.cabinet.hold()
    cabinet.cabinet.world.motion.add(DEEP, 40.0, ACC, cabinet.cabinet.now_s())  # and it died before it let go
    running = cabinet._methods["rob1.MotionControl.getExecId"]
    cabinet._methods["rob1.MotionControl.getExecId"] = lambda p: -1 if cabinet.cabinet.motion.held else running(p)
    other = arm_at(cabinet.port)
    await other.connect()
    await other.enable()
    await asyncio.sleep(0.1)
    assert z_mm(cabinet) == HOME.z_mm
    assert await nothing_is_left(cabinet)
    await other.close()


async def test_a_controller_that_does_not_hold_its_path_is_not_pressed_with(arm: AuboArcs, cabinet: ArcsServer):
    cabinet._methods[STOP_MOVE] = lambda _: 0
    with pytest.raises(MotionFailed, match=r"does not hold its path|holds . of 3 lines"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert await nothing_is_left(cabinet)


async def test_a_controller_that_keeps_fewer_lines_than_it_was_sent_is_not_let_go(arm: AuboArcs, cabinet: ArcsServer):
    move_line = cabinet._methods[LINE]
    cabinet._methods[LINE] = lambda p: 0 if p["duration"] else move_line(p)
    with pytest.raises(MotionFailed, match="holds 2 of 3 lines"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert z_mm(cabinet) == HOME.z_mm


async def test_a_controller_that_refuses_a_line_is_not_let_go(arm: AuboArcs, cabinet: ArcsServer):
    move_line = cabinet._methods[LINE]
    cabinet._methods[LINE] = lambda p: 2 if p["duration"] else move_line(p)
    with pytest.raises(MotionRefused, match="QUEUE_FULL"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert z_mm(cabinet) == HOME.z_mm
    assert await nothing_is_left(cabinet)


async def test_what_cannot_be_carried_out_is_refused_before_anything_is_sent(arm: AuboArcs, cabinet: ArcsServer):
    def refused(*targets: Pose) -> list[QueuedLine]:
        return [QueuedLine(target, 40.0) for target in targets]

    before_each(cabinet, STOP_MOVE, lambda _: pytest.fail("sent"))
    with pytest.raises(LimitExceeded):
        await arm.sequence(refused(DEEP, brush_pose(250.0, -230.0, 60.0), TOP), acc_mm_s2=ACC)
    for lines in ([], refused(DEEP, HOME)):
        with pytest.raises(ValueError, match="must not end where it begins"):
            await arm.sequence(lines, acc_mm_s2=ACC)


async def below(cabinet: ArcsServer, depth_mm: float) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while z_mm(cabinet) > depth_mm:
            await asyncio.sleep(0.002)


@pytest.mark.parametrize("kind", ["malformed", "garbage", "mute", "wrong-id", "drop"])
@pytest.mark.parametrize("method", ["getExecId", "getTcpPose", "getSafetyModeType"])
async def test_an_answer_that_cannot_be_read_in_a_descent_is_asked_again(
    arm: AuboArcs, cabinet: ArcsServer, kind: str, method: str
) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind=kind, on=method, count=2))
    await press
    _, deep, top = list(cabinet.cabinet.world.motion.rests)[-3:]
    assert (deep.pose.z_mm, top.pose.z_mm) == pytest.approx((DEEP.z_mm, TOP.z_mm))
    await arm.move(DEEP, speed_mm_s=100.0, acc_mm_s2=ACC)


@pytest.mark.parametrize("kind", ["malformed", "mute", "drop"])
async def test_a_release_whose_answer_cannot_be_read_is_carried_out(
    arm: AuboArcs, cabinet: ArcsServer, kind: str
) -> None:
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind=kind, on="startMove"))
    await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert z_mm(cabinet) == pytest.approx(TOP.z_mm)


async def test_a_controller_that_never_answers_again_is_given_the_time_of_the_press(
    arm: AuboArcs, cabinet: ArcsServer
) -> None:
    quick = [QueuedLine(line.target, 250.0, 0.2 if line.least_s else 0.0) for line in PRESS]
    press = asyncio.create_task(arm.sequence(quick, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))
    with pytest.raises(DeviceTimeout):
        await press
    assert z_mm(cabinet) == pytest.approx(TOP.z_mm)
    cabinet.faults.clear()


async def test_a_stop_is_carried_out_at_once_although_no_answer_can_be_read(arm: AuboArcs, cabinet: ArcsServer) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind="malformed", on="getSafetyModeType", count=ALWAYS))
    await arm.stop()
    assert z_mm(cabinet) > DEEP.z_mm
    assert cabinet.cabinet.world.motion.size == 0
    cabinet.faults.clear()
    with pytest.raises(MotionFailed):
        await press


async def test_a_safety_stop_that_can_be_read_ends_the_press_at_once(arm: AuboArcs, cabinet: ArcsServer) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe):
        await press
    assert DEEP.z_mm < z_mm(cabinet) < TOP.z_mm
