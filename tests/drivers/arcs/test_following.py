"""Following a way: no halt at its points, none sent after a stop, and everything checked before the first."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from typing import Any

import pytest

from brushloop.drivers.arcs import motion as queueing
from brushloop.drivers.arcs.controller import QueueFull
from brushloop.drivers.arcs.motion import legs_of
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import (
    ConnectionLost,
    LimitExceeded,
    MotionFailed,
    MotionRefused,
    ProtocolViolation,
    RobotNotSafe,
)
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.arcs_server import ArcsServer

WAY = {"speed_mm_s": 40.0, "acc_mm_s2": 800.0, "blend_mm": 1.0}
SLOW = {**WAY, "speed_mm_s": 3.0}


def arc(points: int = 40, radius_mm: float = 40.0) -> list[Pose]:
    """Half a circle from home, the tool leaning and turning as it goes."""
    return [
        brush_pose(
            250.0 + radius_mm * math.sin(math.pi * k / points),
            -230.0 + radius_mm * (1.0 - math.cos(math.pi * k / points)),
            260.0,
            heading_deg=90.0 * k / points,
            tilt_deg=5.0 * k / points,
        )
        for k in range(1, points + 1)
    ]


def line(points: int, step_mm: float = 5.0) -> list[Pose]:
    return [brush_pose(250.0, -230.0 + step_mm * k, 260.0) for k in range(1, points + 1)]


def sent(cabinet: ArcsServer) -> int:
    return cabinet.cabinet.world.motion._next_id


@pytest.fixture
async def way(arm: AuboArcs, cabinet: ArcsServer) -> AsyncIterator[asyncio.Task[None]]:
    """A long slow way that is under way, with more points than are queued at a time."""
    task = asyncio.create_task(arm.follow(line(130, 3.0), **SLOW))
    while sent(cabinet) < queueing.MOST_QUEUED or cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) < 1:
        await asyncio.sleep(0.01)
    yield task
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def to_go_mm(cabinet: ArcsServer) -> float:
    return distance(cabinet.cabinet.world.tool(), line(130, 3.0)[-1])[0]


async def rests_short(cabinet: ArcsServer) -> bool:
    """At rest well before the end, and no line comes after it."""
    before = sent(cabinet)
    await asyncio.sleep(0.15)
    idle = cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1
    return idle and sent(cabinet) == before and to_go_mm(cabinet) > 100.0


async def test_the_arm_ends_at_the_last_pose_having_passed_near_all_the_others(arm: AuboArcs, cabinet: ArcsServer):
    travelled: list[Pose] = []
    world_saw = cabinet.cabinet.world.motion._on_path
    cabinet.cabinet.world.motion._on_path = lambda a, b: (travelled.extend((a, b)), world_saw(a, b))[1]
    await arm.follow(arc(), **WAY)
    off_mm, off_deg = distance(cabinet.cabinet.world.tool(), arc()[-1])
    assert off_mm <= 0.05
    assert off_deg <= 0.1
    for pose in arc():
        # a corner is cut by less than half its blend
        assert min(math.dist(pose.position_mm, seen.position_mm) for seen in travelled) < 0.6


async def test_the_arm_halts_nowhere_but_at_the_end(arm: AuboArcs, cabinet: ArcsServer):
    motion = cabinet.cabinet.world.motion
    cabinet.cabinet.hold()  # so that all lines are there before the first begins, however slow this machine is
    task = asyncio.create_task(arm.follow(arc(12), **WAY))
    while motion.size < 12:
        await asyncio.sleep(0.01)
    cabinet.cabinet.resume()
    await task
    assert len(motion.rests) == 1


async def test_never_more_lines_are_queued_than_allowed(arm: AuboArcs, cabinet: ArcsServer):
    motion = cabinet.cabinet.world.motion
    cabinet.cabinet.hold()
    task = asyncio.create_task(arm.follow(arc(), **WAY))
    while motion.size < queueing.MOST_QUEUED:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.1)
    assert motion.size == queueing.MOST_QUEUED
    cabinet.cabinet.resume()
    await task
    assert sent(cabinet) == len(arc())


@pytest.mark.parametrize(
    "bad", [brush_pose(250.0, -230.0, 60.0), brush_pose(250.0, -230.0, 260.0, tilt_deg=20.0)], ids=["floor", "cone"]
)
async def test_one_pose_outside_the_limits_and_nothing_is_sent(arm: AuboArcs, cabinet: ArcsServer, bad: Pose):
    with pytest.raises(LimitExceeded):
        await arm.follow([*line(5), bad], **WAY)
    with pytest.raises(ValueError, match="no poses"):
        await arm.follow([], **WAY)
    assert sent(cabinet) == 0


async def test_a_stop_in_mid_path_ends_it_and_no_line_follows(
    arm: AuboArcs, cabinet: ArcsServer, way: asyncio.Task[None]
):
    await arm.stop()
    assert await rests_short(cabinet)
    with pytest.raises(MotionFailed, match="was stopped"):
        await way


async def test_a_stop_while_lines_are_being_sent_lets_none_follow(arm: AuboArcs, cabinet: ArcsServer):
    queue_line, stops = cabinet._methods["rob1.MotionControl.moveLine"], list[asyncio.Task[None]]()

    def noted(params: dict[str, Any]) -> object:
        stops.append(asyncio.create_task(arm.stop()))
        return queue_line(params)

    cabinet._methods["rob1.MotionControl.moveLine"] = noted
    with pytest.raises(MotionFailed):
        await arm.follow(line(10), **WAY)
    await asyncio.gather(*stops)
    assert sent(cabinet) == 1


async def test_a_cancelled_way_is_stopped(arm: AuboArcs, cabinet: ArcsServer, way: asyncio.Task[None]):
    way.cancel()
    with pytest.raises(asyncio.CancelledError):
        await way
    assert await rests_short(cabinet)


async def test_a_stop_by_somebody_else_is_noticed_and_not_driven_over(cabinet: ArcsServer, way: asyncio.Task[None]):
    cabinet.cabinet.stop(2.0, 2.0)
    with pytest.raises(MotionFailed, match="from where it was sent"):
        await way
    assert await rests_short(cabinet)


async def test_a_protective_stop_in_mid_path_is_reported_as_such(cabinet: ArcsServer, way: asyncio.Task[None]):
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe, match="ProtectiveStop"):
        await way
    assert to_go_mm(cabinet) > 100.0


async def test_a_connection_that_is_lost_in_mid_path_stops_the_arm(
    arm: AuboArcs, cabinet: ArcsServer, way: asyncio.Task[None]
):
    assert arm._motion.connection._writer is not None
    arm._motion.connection._writer.transport.abort()
    with pytest.raises(ConnectionLost):
        await way
    assert await rests_short(cabinet)


async def test_a_controller_that_holds_few_lines_is_fed_as_it_takes_them(arm: AuboArcs, cabinet: ArcsServer):
    cabinet.cabinet.world.motion._capacity = 3
    await arm.follow(arc(), **WAY)
    assert distance(cabinet.cabinet.world.tool(), arc()[-1])[0] <= 0.05


async def test_a_queue_that_somebody_else_fills_is_an_error(arm: AuboArcs, cabinet: ArcsServer):
    cabinet._methods["rob1.MotionControl.moveLine"] = lambda _: 2
    with pytest.raises(QueueFull):
        await arm.follow(line(5), **WAY)


async def test_a_queue_that_stays_full_in_mid_path_ends_it(
    arm: AuboArcs, cabinet: ArcsServer, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(queueing, "STUCK_S", 0.2)
    move_line = cabinet._methods["rob1.MotionControl.moveLine"]
    cabinet._methods["rob1.MotionControl.moveLine"] = lambda p: 2 if sent(cabinet) >= 3 else move_line(p)
    with pytest.raises(MotionFailed, match="does not advance"):
        await arm.follow(line(5), **WAY)
    assert await rests_short(cabinet)


async def test_a_line_that_is_refused_in_mid_path_ends_it(arm: AuboArcs, cabinet: ArcsServer):
    move_line = cabinet._methods["rob1.MotionControl.moveLine"]
    cabinet._methods["rob1.MotionControl.moveLine"] = lambda p: -5 if sent(cabinet) == 5 else move_line(p)
    with pytest.raises(MotionRefused, match="refused with -5"):
        await arm.follow(line(130, 3.0), **SLOW)
    assert await rests_short(cabinet)


async def test_a_way_that_is_fed_too_slowly_goes_on_and_is_reported(
    arm: AuboArcs, cabinet: ArcsServer, monkeypatch: pytest.MonkeyPatch
):
    reported: list[str] = []
    arm._notice = reported.append
    monkeypatch.setattr(queueing, "MOST_QUEUED", 1)
    await arm.follow(line(4), **WAY)
    assert distance(cabinet.cabinet.world.tool(), line(4)[-1])[0] <= 0.05
    assert reported[0] == "the arm halted at point 1 of 4: lines did not reach the controller in time"


async def test_an_arm_that_does_not_advance_is_not_waited_for_for_ever(
    cabinet: ArcsServer, way: asyncio.Task[None], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(queueing, "STUCK_S", 0.1)
    cabinet.cabinet.hold()
    with pytest.raises(MotionFailed, match="does not advance"):
        await way


@pytest.mark.parametrize("answer", [None, "3", -1, 1.5, True])
async def test_a_queue_without_a_size_is_a_violation(arm: AuboArcs, cabinet: ArcsServer, answer: object):
    cabinet._methods["rob1.MotionControl.getQueueSize"] = lambda _: answer
    with pytest.raises(ProtocolViolation, match="getQueueSize"):
        await arm.follow(line(40, 3.0), **SLOW)


def test_a_turn_slows_its_own_line_and_corners_are_never_rounded_by_less_than_the_controller_takes(limits: Limits):
    start = brush_pose(250.0, -230.0, 260.0)
    poses = [brush_pose(252.0, -230.0, 260.0), brush_pose(254.0, -230.0, 260.0, heading_deg=30.0), line(40)[-1]]
    legs = legs_of(start, [QueuedLine(pose, 40.0) for pose in poses], limits, 800.0, blend_mm=5.0)
    assert [leg.blend_mm for leg in legs] == [1.0, 1.0, 0.0]
    assert legs[1].speed_mm_s == pytest.approx(45.0 * 2.0 / 30.0)
    assert legs[0].speed_mm_s == 40.0
