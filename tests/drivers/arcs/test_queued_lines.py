"""Lines that are queued: a way that is fed as it is followed, and a press that begins once all of it is there.

What another client, a lost host or an answer that nobody can read does to either.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from brushloop.drivers.arcs import motion as queueing
from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.motion import as_sent
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceTimeout,
    LimitExceeded,
    MotionFailed,
    MotionRefused,
    PathDisturbed,
    ProtocolViolation,
    RobotNotSafe,
)
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.cabinet import MOST_MOVES
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from tests.drivers.arcs.conftest import LIMITS, Act, Cabinet, Ends, MakeArm, cut, enabled, mute

WAY = {"speed_mm_s": 40.0, "acc_mm_s2": 800.0}
SLOW = {**WAY, "speed_mm_s": 3.0}
ARC = [
    brush_pose(
        250.0 + 40.0 * math.sin(math.pi * share),
        -230.0 + 40.0 * (1.0 - math.cos(math.pi * share)),
        260.0,
        heading_deg=90.0 * share,
        tilt_deg=5.0 * share,
    )
    for share in (k / 40 for k in range(1, 41))
]
"""Half a circle from home, the tool leaning and turning as it goes."""


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
    await arm.follow(ARC, **WAY)
    off_mm, off_deg = distance(cabinet.tool, ARC[-1])
    assert off_mm <= 0.05
    assert off_deg <= 0.1
    for pose in ARC:
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


# ---------------------------------------------------------------- a press

X_MM, Y_MM = 250.0, -230.0
HOME, TOP, DEEP = (brush_pose(X_MM, Y_MM, z_mm) for z_mm in (260.0, 300.0, 200.0))
DWELL_S = 4.0
PRESS = [QueuedLine(brush_pose(X_MM, Y_MM, 200.05), 40.0), QueuedLine(DEEP, 40.0, DWELL_S), QueuedLine(TOP, 40.0)]
ACC = 800.0
ASIDE = brush_pose(X_MM + 40.0, Y_MM + 10.0, 205.0)
"""In the paper, and 41 mm beside the press."""
LINE, SIZE, STOP_MOVE, START_MOVE = (
    f"MotionControl.{name}" for name in ("moveLine", "getQueueSize", "stopMove", "startMove")
)


async def below(cabinet: Cabinet, height_mm: float) -> None:
    """Return once the tip is lower than this."""
    while cabinet.tool.z_mm > height_mm:
        await asyncio.sleep(0.002)


async def nothing_is_left(cabinet: Cabinet) -> bool:
    """No line is queued, and none begins when somebody lets the path go on."""
    here = cabinet.tool
    cabinet.cabinet.resume()
    await asyncio.sleep(0.1)
    return cabinet.queued == 0 and cabinet.tool == here


async def test_the_arm_goes_down_dwells_and_comes_up_once_the_controller_has_every_line(
    arm: AuboArcs, cabinet: Cabinet
):
    held: list[tuple[float, int]] = []
    cabinet.before_each(START_MOVE, lambda _: held.append((cabinet.tool.z_mm, cabinet.queued)))
    seen = await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert held == [(HOME.z_mm, 3)]
    assert distance(cabinet.tool, TOP)[0] <= 0.05
    assert min(pose.z_mm for pose in seen) == pytest.approx(200.0, abs=0.05)
    near, deep, top = list(cabinet.cabinet.world.motion.rests)[-3:]
    assert (near.pose.z_mm, deep.pose.z_mm, top.pose.z_mm) == pytest.approx((200.05, 200.0, 300.0))
    assert deep.at_s - near.at_s == pytest.approx(DWELL_S, abs=1e-3)


def sends_aside(_: AuboArcs, cabinet: Cabinet) -> None:
    """Another client's line reaches the controller now."""
    assert cabinet.cabinet.world.motion.add(ASIDE, 200.0, ACC, cabinet.cabinet.now_s())


@pytest.mark.parametrize(
    ("act", "ends"),
    [
        (lambda arm, _: cut(arm._motion), pytest.raises(ConnectionLost, match="closed the connection")),
        (
            lambda arm, _: asyncio.create_task(arm.stop()),
            pytest.raises(MotionFailed, match=r"was stopped|holds 0 of 3 lines"),
        ),
        (sends_aside, pytest.raises(PathDisturbed, match=r"holds 4 lines, but 3 were sent.*nother client")),
    ],
)
@pytest.mark.parametrize(("method", "number"), [(STOP_MOVE, 1), (LINE, 1), (LINE, 3), (SIZE, 1)])
async def test_whatever_happens_before_the_path_is_let_go_drops_it_and_leaves_the_arm_where_it_is(
    arm: AuboArcs, cabinet: Cabinet, method: str, number: int, act: Act, ends: Ends
):
    tasks: list[asyncio.Task[None] | None] = []
    cabinet.before_each(method, lambda now: tasks.append(act(arm, cabinet)) if now == number else None)
    with ends:
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    await asyncio.gather(*filter(None, tasks))
    assert cabinet.tool.z_mm == HOME.z_mm
    assert await nothing_is_left(cabinet)
    if not arm._motion.lost:
        await arm.follow([TOP], speed_mm_s=100.0, acc_mm_s2=ACC)  # the hold is over, too


async def is_stopped_although_no_answer_can_be_read(arm: AuboArcs, cabinet: Cabinet) -> None:
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind="malformed", on="getSafetyModeType", count=ALWAYS))
    await arm.stop()
    cabinet.faults.clear()


@pytest.mark.parametrize(
    ("below_mm", "act", "error"),
    [
        (250.0, lambda arm, _: arm.stop(), MotionFailed),
        (200.1, lambda arm, _: arm.stop(), MotionFailed),
        (255.0, is_stopped_although_no_answer_can_be_read, MotionFailed),
        (255.0, lambda _, cabinet: cabinet.cabinet.safety_stop(), RobotNotSafe),
    ],
)
async def test_a_stop_on_the_way_down_or_at_depth_ends_the_press_at_once_and_drops_the_lift(
    arm: AuboArcs, cabinet: Cabinet, below_mm: float, act: Act, error: type[Exception]
):
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, below_mm)
    if (stop := act(arm, cabinet)) is not None:
        await stop
    with pytest.raises(error):
        await press
    assert DEEP.z_mm <= cabinet.tool.z_mm <= below_mm
    assert await nothing_is_left(cabinet)


@pytest.mark.parametrize("counted", [True, False], ids=["a held line counts as running", "or not"])
async def test_lines_that_a_dead_process_left_held_are_dropped_and_do_not_hold_up_the_next_one(
    arm: AuboArcs, cabinet: Cabinet, make_arm: MakeArm, counted: bool
):
    await arm.close()
    cabinet.cabinet.hold()
    cabinet.cabinet.world.motion.add(DEEP, 40.0, ACC, cabinet.cabinet.now_s())  # and it died before it let go
    running = cabinet._methods["rob1.MotionControl.getExecId"]
    if not counted:
        cabinet._methods["rob1.MotionControl.getExecId"] = lambda p: -1 if cabinet.cabinet.motion.held else running(p)
    other = await enabled(make_arm)
    assert cabinet.tool.z_mm == HOME.z_mm
    assert await nothing_is_left(cabinet)
    await other.follow([TOP], speed_mm_s=100.0, acc_mm_s2=ACC)


def does_not_hold(cabinet: Cabinet) -> None:
    cabinet.answers(STOP_MOVE, 0)
    cabinet.before_each(LINE, lambda _: asyncio.get_running_loop().simulated.pass_s(0.01))  # as a line over a network


@pytest.mark.parametrize(
    ("tamper", "ends"),
    [
        (does_not_hold, pytest.raises(MotionFailed, match=r"does not hold its path|holds . of 3")),
        (
            lambda c: c.refuses_lines(0, lambda line: line["duration"]),
            pytest.raises(MotionFailed, match="holds 2 of 3"),
        ),
        (lambda c: c.refuses_lines(2, lambda line: line["duration"]), pytest.raises(MotionRefused, match="QUEUE_FULL")),
    ],
    ids=["does not hold", "keeps fewer lines", "refuses a line"],
)
async def test_a_controller_that_does_not_keep_all_lines_is_not_let_go(
    arm: AuboArcs, cabinet: Cabinet, tamper: Callable[[Cabinet], None], ends: Ends
):
    tamper(cabinet)
    with ends:
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert cabinet.tool.z_mm > DEEP.z_mm
    assert await nothing_is_left(cabinet)


async def test_what_cannot_be_carried_out_is_refused_before_anything_is_sent(arm: AuboArcs, cabinet: Cabinet):
    cabinet.before_each(STOP_MOVE, lambda _: pytest.fail("sent"))
    with pytest.raises(LimitExceeded):
        await arm.sequence([*PRESS, QueuedLine(brush_pose(250.0, -230.0, 60.0), 40.0)], acc_mm_s2=ACC)
    with pytest.raises(ValueError, match="no poses"):
        await arm.follow([], speed_mm_s=40.0, acc_mm_s2=ACC)
    for lines in ([], [QueuedLine(DEEP, 40.0), QueuedLine(HOME, 40.0)]):
        with pytest.raises(ValueError, match="must not end where it begins"):
            await arm.sequence(lines, acc_mm_s2=ACC)


@pytest.mark.parametrize("kind", ["malformed", "garbage", "mute"])
@pytest.mark.parametrize("method", ["startMove", "getExecId", "getTcpPose", "getSafetyModeType"])
async def test_an_answer_that_cannot_be_read_once_the_path_was_let_go_does_not_stop_it(
    arm: AuboArcs, cabinet: Cabinet, kind: str, method: str
) -> None:
    fault = Fault(device=Device.ROBOT, kind=kind, on=method, count=1 if method == "startMove" else 2)
    cabinet.before_each(START_MOVE, lambda _: cabinet.faults.hang(fault))
    await arm.sequence(PRESS, acc_mm_s2=ACC)
    _, deep, top = list(cabinet.cabinet.world.motion.rests)[-3:]
    assert (deep.pose.z_mm, top.pose.z_mm) == pytest.approx((DEEP.z_mm, TOP.z_mm))
    await arm.follow([DEEP], speed_mm_s=100.0, acc_mm_s2=ACC)


async def test_a_controller_that_never_answers_again_is_given_the_time_of_the_press(
    arm: AuboArcs, cabinet: Cabinet
) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    mute(cabinet)
    with pytest.raises(DeviceTimeout):
        await press
    assert cabinet.tool.z_mm == pytest.approx(TOP.z_mm)
    cabinet.faults.clear()


# ---------------------------------------------------------------- another client


@pytest.mark.parametrize("at_mm", [None, 250.0, 200.01], ids=["as the path is released", "on the way down", "at depth"])
async def test_a_line_that_comes_after_the_last_check_is_not_begun(
    arm: AuboArcs, cabinet: Cabinet, at_mm: float | None
) -> None:
    passed = cabinet.passed()
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    if at_mm is None:
        cabinet.before_each(START_MOVE, lambda _: sends_aside(arm, cabinet))
    else:
        await below(cabinet, at_mm)
        sends_aside(arm, cabinet)
    with pytest.raises(PathDisturbed, match=r"holds \d lines, but at most \d of those sent can be left.*nother client"):
        await press
    assert all(math.hypot(p.x_mm - X_MM, p.y_mm - Y_MM) < 0.5 for p in passed if p.z_mm < 219.9), "in the paper"
    assert cabinet.queued == 0


async def test_a_client_that_stops_the_press_and_sends_its_own_line_is_seen_by_asking_for_the_tip(
    arm: AuboArcs, cabinet: Cabinet, other: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arm._telemetry, "_take", lambda *_: None)
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 200.01)
    await other.halt(2.0)
    await other.move_line(ASIDE, 200.0, ACC)
    with pytest.raises(PathDisturbed, match=r"from its path.*nother client"):
        await press
    assert cabinet.queued == 0


async def test_one_pose_beside_the_path_is_enough_even_if_the_arm_arrives(arm: AuboArcs) -> None:
    """Between two questions of the driver the tip may have been elsewhere; telemetry saw it."""
    telemetry = arm._telemetry
    reaching = telemetry.reaching

    async def reached(*target: Any) -> None:
        assert telemetry._seen is not None
        telemetry._seen.append(brush_pose(X_MM + 0.8, Y_MM, 201.0))
        await reaching(*target)

    telemetry.reaching = reached  # type: ignore[method-assign]
    with pytest.raises(PathDisturbed, match=r"0\.80 mm"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
