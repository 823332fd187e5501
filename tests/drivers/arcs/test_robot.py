"""The arm's driver: connecting, a move, and a stop from any state, never queued behind anything."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping

import pytest

from brushloop.drivers.arcs import stopping, wire
from brushloop.drivers.arcs.controller import ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.arcs.motion import durations_s
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import QueuedLine
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    MotionError,
    NotConnected,
    RobotNotSafe,
    RpcError,
)
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.faults import ALWAYS, Fault
from tests.drivers.arcs.conftest import NEAR, QUICK, Act, Cabinet, MakeArm, mute_to
from tests.waiting import until

FAR = brush_pose(250.0, -30.0, 260.0)  # 200 mm from home: two seconds of the fast clock
SLOW = {"speed_mm_s": 5.0, "acc_mm_s2": 800.0}


@pytest.mark.parametrize(("box", "simulated"), [(None, True), ("cb_ISStation", False)])
async def test_connecting_reports_who_answers_and_where_the_flange_is(
    cabinet: Cabinet, make_arm: MakeArm, box: str | None, simulated: bool
):
    if box is not None:
        cabinet.answers("RobotConfig.getControlBoxType", box)
    arm = make_arm()
    identity = await arm.connect()
    assert identity.simulated is simulated
    assert identity.model.startswith("aubo_i5")
    assert arm.latest().pose.position_mm == pytest.approx((250.0, -230.0, 260.0 + 180.0)), "no tool is set yet"
    with pytest.raises(NotConnected, match="not enabled"):
        await arm.move(NEAR, **QUICK)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF
    await arm.close()
    await arm.close()
    with pytest.raises(NotConnected):
        await arm.stop()


def test_a_line_is_timed_with_its_ramps_and_a_turn_on_the_spot_in_radians():
    start, short, long, waiting, turned = (
        brush_pose(x_mm, 0.0, 0.0, heading_deg=turn_deg)
        for x_mm, turn_deg in [(0.0, 0.0), (0.25, 0.0), (8.25, 0.0), (8.5, 0.0), (8.5, 90.0)]
    )
    lines = [QueuedLine(short, 20.0), QueuedLine(long, 20.0), QueuedLine(waiting, 20.0, 3.0), QueuedLine(turned, 20.0)]
    expected_s = [2.0 * math.sqrt(0.25 / 800.0), 0.4 + 0.025, 3.0, math.radians(90.0) / 0.020 + 0.025]
    assert durations_s(start, lines, 800.0) == pytest.approx(expected_s)


@pytest.mark.parametrize("mode", ["ArmOnFire", None])
async def test_a_safety_mode_that_nobody_knows_forbids_motion(arm: AuboArcs, cabinet: Cabinet, mode: object):
    cabinet.answers("RobotState.getSafetyModeType", mode)
    with pytest.raises(RobotNotSafe, match="Look at the pendant"):
        await arm.move(NEAR, **QUICK)


async def test_a_cabinet_of_the_older_generation_is_named_as_such(
    make_arm: MakeArm, unused_tcp_port: int, monkeypatch: pytest.MonkeyPatch
):
    async with await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0) as older:
        monkeypatch.setattr(wire, "AUBOPE_PORT", older.sockets[0].getsockname()[1])
        with pytest.raises(DeviceError, match=r"AUBOPE.*ask the maker"):
            await make_arm(port=unused_tcp_port).connect()
    monkeypatch.setattr(wire, "AUBOPE_PORT", unused_tcp_port)
    with pytest.raises(ConnectionLost):
        await make_arm(port=unused_tcp_port).connect()


async def test_a_connect_that_fails_half_way_leaves_nothing_open(cabinet: Cabinet, make_arm: MakeArm):
    del cabinet._methods["rob1.RobotConfig.getRobotType"]
    arm = make_arm()
    with pytest.raises(RpcError, match="-32601"):
        await arm.connect()
    await arm.close()
    await until(lambda: cabinet.clients == 0, "the connections to be closed")


# ---------------------------------------------------------------- one bad answer in a move


def to_go_mm(cabinet: Cabinet) -> float:
    return distance(cabinet.tool, FAR)[0]


@pytest.mark.parametrize("kind", ["mute", "deaf"])
async def test_a_controller_that_falls_silent_is_reported_as_an_arm_that_may_still_move(
    arm: AuboArcs, cabinet: Cabinet, kind: str
):
    """`mute` carries out the stop and cannot say so, `deaf` does not: from outside both look alike."""
    fault = {"device": "robot", "kind": kind, "phase": "travelling", "nth": 5, "count": ALWAYS}
    cabinet.faults.hang(Fault.model_validate(fault))
    with pytest.raises(DeviceTimeout) as caught:
        await arm.move(FAR, **SLOW)
    [note] = caught.value.__notes__
    assert "The arm may still be moving. Use the emergency stop." in note
    if kind == "mute":
        assert cabinet.rests
    closing = asyncio.create_task(arm.close())
    for _ in range(2):
        await asyncio.sleep(0.1)
        closing.cancel()  # it goes on although it is cancelled
    with pytest.raises(MotionError, match="may still be moving"):
        await closing


@pytest.mark.parametrize(
    ("kind", "mode", "condition", "power"),
    [
        ("protective-stop", SafetyMode.PROTECTIVE_STOP, "brakes open", RobotMode.RUNNING),
        ("safeguard-stop", SafetyMode.SAFEGUARD_STOP, "brakes on", RobotMode.RUNNING),
        ("emergency-stop", SafetyMode.ROBOT_EMERGENCY_STOP, "no power", RobotMode.POWER_OFF),
    ],
)
async def test_a_safety_stop_in_mid_move_is_named_with_its_condition_and_stays_until_a_person_ends_it(
    arm: AuboArcs, cabinet: Cabinet, kind: str, mode: SafetyMode, condition: str, power: RobotMode
):
    box = cabinet.cabinet
    cabinet.faults.hang(Fault.model_validate({"device": "robot", "kind": kind, "phase": "travelling"}))
    watching = asyncio.create_task(cabinet.faults.watch(box.safety_stop))
    with pytest.raises(RobotNotSafe, match=f"safety mode is {mode}") as caught:
        await arm.move(FAR, **SLOW)
    assert condition in caught.value.condition
    assert caught.value.remedy
    assert cabinet.rests
    left_mm = to_go_mm(cabinet)
    assert 100.0 < left_mm < 200.0
    for attempt in (arm.move(NEAR, **QUICK), arm.enable()):
        with pytest.raises(RobotNotSafe):
            await attempt
    if mode is SafetyMode.ROBOT_EMERGENCY_STOP:
        box.safety_stop()  # takes the place of nothing that is worse
        assert box.power.power_on() == ReturnCode.BAD_STATE
    assert (box.power.safety, box.power.mode) == (mode, power), "nothing clears it"
    box.release()
    box.resume()  # whoever resumes finds no path: the driver's own stop has dropped it
    await asyncio.sleep(0.1)
    assert to_go_mm(cabinet) == left_mm
    await arm.enable()
    await arm.move(FAR, **QUICK)
    watching.cancel()


# ---------------------------------------------------------------- stop


def loses_what_is_sent_to_stop(arm: AuboArcs, _: Cabinet) -> None:
    async def silence(*_: object) -> None:
        await asyncio.sleep(1.0)
        raise DeviceTimeout("robot", "stopLine", "no reply in 1 s")

    arm._stop.call = silence  # type: ignore[method-assign]


@pytest.mark.parametrize(
    "act",
    [
        lambda _, cabinet: mute_to(cabinet, "rob1.MotionControl.getExecId"),
        lambda _, cabinet: mute_to(cabinet, "rob1.RobotState.getSafetyModeType"),
        lambda _, cabinet: cabinet.drop_clients(),
        loses_what_is_sent_to_stop,
    ],
    ids=["no id", "no safety mode", "no connection", "no answer to a stop"],
)
async def test_a_stop_gets_through_at_once_whatever_hangs(arm: AuboArcs, cabinet: Cabinet, act: Act):
    move = asyncio.create_task(arm.move(FAR, **SLOW))
    await asyncio.sleep(0.2)
    act(arm, cabinet)
    pressed = asyncio.create_task(arm.stop())
    await asyncio.sleep(0.5)
    assert cabinet.rests
    assert 100.0 < to_go_mm(cabinet) < 199.0, "far from its target and not back at its start"
    await pressed  # it returns once rest has been seen
    with pytest.raises(DeviceError):
        await move


async def test_nothing_moves_while_there_is_no_way_to_stop_it(arm: AuboArcs, cabinet: Cabinet):
    await cabinet.stop()
    with pytest.raises(ConnectionLost):
        await arm.move(FAR, **SLOW)
    assert to_go_mm(cabinet) == pytest.approx(200.0)


@pytest.mark.parametrize("delay_s", [0.25, 1.2], ids=["a stop overtakes it", "it counts as lost"])
async def test_a_line_that_is_still_on_its_way_is_stopped_too(
    arm: AuboArcs, cabinet: Cabinet, monkeypatch: pytest.MonkeyPatch, delay_s: float
):
    """Its network delivers everything later, in order."""
    connection, sent = arm._motion, asyncio.Event()
    send, loop = connection.call, asyncio.get_running_loop()

    async def delayed(method: str, params: Mapping[str, object] | None = None) -> object:
        if method.endswith("moveLine"):
            assert connection._stream is not None
            _, writer = connection._stream
            write = writer.write
            monkeypatch.setattr(writer, "write", lambda data: loop.call_later(delay_s, write, data))
            sent.set()
        return await send(method, params)

    monkeypatch.setattr(connection, "call", delayed)
    move = asyncio.create_task(arm.move(FAR, **SLOW))
    await sent.wait()
    if delay_s < 1.0:
        await arm.stop()
    else:
        monkeypatch.setattr(stopping, "RESTS_NEEDED", 20)  # the line comes within the time that rest is asked for
    with pytest.raises((MotionError, DeviceTimeout)):
        await move
    stopped_mm = to_go_mm(cabinet)
    await asyncio.sleep(2.0)
    assert cabinet.rests
    assert to_go_mm(cabinet) == pytest.approx(stopped_mm)
    assert stopped_mm > 100.0
