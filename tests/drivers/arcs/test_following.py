"""Following a way: no halt at its points, none sent after a stop, and everything checked before the first."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator

import pytest

from brushloop.drivers.arcs import motion as queueing
from brushloop.drivers.arcs.motion import as_sent
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import ConnectionLost, MotionFailed, MotionRefused, ProtocolViolation, RobotNotSafe
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.cabinet import MOST_MOVES
from tests.drivers.arcs.conftest import LIMITS, Act, Cabinet, Ends, cut

WAY = {"speed_mm_s": 40.0, "acc_mm_s2": 800.0}
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


LONG = line(130, 3.0)
"""More points than are queued at a time."""


@pytest.fixture
async def way(arm: AuboArcs, cabinet: Cabinet) -> AsyncIterator[asyncio.Task[None]]:
    """A long slow way that is under way."""
    task = asyncio.create_task(arm.follow(LONG, **SLOW))
    while cabinet.taken < queueing.MOST_QUEUED or cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) < 1:
        await asyncio.sleep(0.01)
    assert cabinet.queued <= queueing.MOST_QUEUED
    yield task
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def rests_short(cabinet: Cabinet) -> bool:
    """At rest well before the end, and no line comes after it."""
    before = cabinet.taken
    await asyncio.sleep(0.15)
    return cabinet.rests and cabinet.taken == before and distance(cabinet.tool, LONG[-1])[0] > 100.0


async def test_the_arm_halts_nowhere_but_at_the_last_pose_having_passed_near_all_the_others(
    arm: AuboArcs, cabinet: Cabinet
):
    passed = cabinet.passed()
    await arm.follow(arc(), **WAY)
    off_mm, off_deg = distance(cabinet.tool, arc()[-1])
    assert off_mm <= 0.05
    assert off_deg <= 0.1
    for pose in arc():
        # a corner is cut by less than half its blend
        assert min(math.dist(pose.position_mm, seen.position_mm) for seen in passed) < 0.6
    assert len(cabinet.cabinet.world.motion.rests) == 1


@pytest.mark.parametrize(
    ("act", "ends"),
    [
        (lambda arm, _: asyncio.create_task(arm.stop()), pytest.raises(MotionFailed, match="was stopped")),
        (lambda _, cabinet: cabinet.cabinet.stop(2.0, 2.0), pytest.raises(MotionFailed, match="does not advance")),
        (lambda _, cabinet: cabinet.cabinet.hold(), pytest.raises(MotionFailed, match="does not advance")),
        (lambda _, cabinet: cabinet.cabinet.safety_stop(), pytest.raises(RobotNotSafe, match="ProtectiveStop")),
        (lambda arm, _: cut(arm._motion), pytest.raises(ConnectionLost, match=r"closed|lost|reset|abort|connection")),
    ],
    ids=["stopped", "stopped by another client", "held", "stopped by itself", "cut off"],
)
async def test_whatever_ends_a_way_is_named_and_no_line_follows(
    arm: AuboArcs, cabinet: Cabinet, way: asyncio.Task[None], act: Act, ends: Ends
):
    stopping = act(arm, cabinet)
    with ends:
        await way
    assert await rests_short(cabinet)
    if stopping:
        await stopping


async def test_a_stop_while_lines_are_being_sent_lets_none_follow(arm: AuboArcs, cabinet: Cabinet):
    stops: list[asyncio.Task[None]] = []
    cabinet.before_each("MotionControl.moveLine", lambda _: stops.append(asyncio.create_task(arm.stop())))
    with pytest.raises(MotionFailed):
        await arm.follow(line(10), **WAY)
    await asyncio.gather(*stops)
    assert cabinet.taken == 1


async def test_a_controller_that_holds_few_lines_is_fed_as_it_takes_them(
    arm: AuboArcs, cabinet: Cabinet, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(queueing, "MOST_QUEUED", 2 * MOST_MOVES)
    queued: list[int] = []
    cabinet.before_each("MotionControl.moveLine", lambda _: queued.append(cabinet.queued))
    await arm.follow(LONG, speed_mm_s=200.0, acc_mm_s2=800.0)
    assert max(queued) == MOST_MOVES
    assert distance(cabinet.tool, LONG[-1])[0] <= 0.05


@pytest.mark.parametrize(
    ("accepted", "code", "ends"),
    [
        (0, 2, pytest.raises(MotionRefused, match="Another client")),
        (3, 2, pytest.raises(MotionFailed, match="does not advance")),
        (5, -5, pytest.raises(MotionRefused, match="refused with -5")),
    ],
    ids=["a queue that somebody else fills", "one that stays full", "a line that is refused"],
)
async def test_a_line_that_is_not_taken_ends_the_way(
    arm: AuboArcs, cabinet: Cabinet, accepted: int, code: int, ends: Ends
):
    cabinet.refuses_lines(code, lambda _: cabinet.taken >= accepted)
    with ends:
        await arm.follow(LONG, **SLOW)
    assert await rests_short(cabinet)


async def test_a_way_that_is_fed_too_slowly_goes_on_and_is_reported(
    arm: AuboArcs, cabinet: Cabinet, notices: list[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(queueing, "MOST_QUEUED", 1)
    await arm.follow(line(4), **WAY)
    assert distance(cabinet.tool, line(4)[-1])[0] <= 0.05
    assert notices[0] == "the arm halted at point 1 of 4: lines did not reach the controller in time"


@pytest.mark.parametrize("answer", [-1, True])
async def test_a_queue_without_a_size_is_a_violation(arm: AuboArcs, cabinet: Cabinet, answer: object):
    cabinet.answers("MotionControl.getQueueSize", answer)
    with pytest.raises(ProtocolViolation, match="getQueueSize"):
        await arm.follow(LONG, **SLOW)


def test_a_turn_slows_its_own_line():
    start = brush_pose(250.0, -230.0, 260.0)
    poses = [brush_pose(252.0, -230.0, 260.0), brush_pose(254.0, -230.0, 260.0, heading_deg=30.0), line(40)[-1]]
    legs = as_sent(start, [QueuedLine(pose, 40.0) for pose in poses], LIMITS)
    assert legs[1].speed_mm_s == pytest.approx(45.0 * 2.0 / 30.0)
    assert legs[0].speed_mm_s == 40.0
