"""The arm's driver: connecting, what must be so before a line is sent, a move, and a stop from any state.

A stop is never queued behind anything.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Any

import pytest

from brushloop.drivers.arcs import stopping, wire
from brushloop.drivers.arcs.controller import Controller, ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.arcs.motion import durations_s, until_settled
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import Settings
from brushloop.drivers.devices import QueuedLine
from brushloop.drivers.errors import (
    ArmMoved,
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    MotionError,
    MotionFailed,
    MotionRefused,
    NotConnected,
    NotPowered,
    RobotNotSafe,
    RpcError,
    SettingsChanged,
)
from brushloop.drivers.geometry import brush_pose, distance, from_wire, lean, to_wire
from brushloop.drivers.sim.faults import ALWAYS, Fault
from brushloop.drivers.sim.kinematics import forward, pose_of
from tests.drivers.arcs.conftest import NEAR, QUICK, Act, Cabinet, MakeArm, enabled, mute_to
from tests.waiting import until

ABOVE, LOW = brush_pose(300.0, -200.0, 200.0), brush_pose(300.0, -200.0, 130.0)
ELSEWHERE = brush_pose(340.0, -180.0, 100.0, tilt_deg=10.0)
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
        await arm.follow([NEAR], **QUICK)
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
        await arm.follow([NEAR], **QUICK)


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


# ---------------------------------------------------------------- what is set and checked


@pytest.mark.parametrize("mode", ["Manual", None])
async def test_an_arm_that_is_not_on_automatic_is_neither_set_nor_powered(
    make_arm: MakeArm, cabinet: Cabinet, mode: object
):
    cabinet.answers("RobotManage.getOperationalMode", mode)
    with pytest.raises(MotionError, match=f"operational mode is {mode}.*on the pendant"):
        await enabled(make_arm)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF
    assert cabinet.cabinet.tcp_offset == [0.0] * 6


async def test_what_is_configured_is_set_in_the_wires_units_and_a_brush_askew_on_its_flange_is_pressed_upright(
    make_arm: MakeArm, cabinet: Cabinet
):
    box, before = cabinet.cabinet, cabinet.tool
    turn = {"tcp_offset_mm": (4.0, -7.0, 180.0), "tcp_rotation_deg": (2.0, -1.5, 0.0)}
    arm = await enabled(make_arm, **turn, payload_kg=0.4, payload_cog_mm=(0.0, 1.0, 60.0), collision_level=8)
    assert (box.payload, box.collision_level) == ([0.4, [0.0, 0.001, 0.06], [0.0] * 3, [0.0] * 6], 8)
    assert box.tcp_offset == pytest.approx([0.004, -0.007, 0.18, math.radians(2.0), math.radians(-1.5), 0.0])
    assert (box.power.mode, box.world.tool()) == (RobotMode.RUNNING, before), "nothing has moved"
    await arm.follow([NEAR], **QUICK)
    joints = box.motion.near_joints(cabinet.tool)
    flange = from_wire(box.fk({"q": [*joints]})[0])
    assert distance(flange, NEAR)[0] < 0.1
    assert lean(pose_of(forward(joints)))[0] == pytest.approx(2.5, abs=0.05)


async def test_reduced_mode_and_a_cabinet_without_operational_modes_are_allowed(make_arm: MakeArm, cabinet: Cabinet):
    cabinet.cabinet.operational_mode = "Disabled"
    cabinet.cabinet.power.safety = SafetyMode.REDUCED
    await (await enabled(make_arm)).follow([NEAR], **QUICK)


@pytest.mark.parametrize(
    ("method", "code", "error", "words"),
    [
        *((method, -5, MotionRefused, method) for method in ("setTcpOffset", "setPayload", "setCollisionLevel")),
        *(
            ("setTcpOffset", code, SettingsChanged, r"tool offset is \(0, 0, 0\) mm, .*, not \(0, 0, 180\)")
            for code in (0, 13)
        ),
    ],
)
async def test_what_the_controller_does_not_take_whatever_it_returns_keeps_the_power_off(
    make_arm: MakeArm, cabinet: Cabinet, method: str, code: int, error: type[Exception], words: str
):
    cabinet.answers(f"RobotConfig.{method}", code)
    with pytest.raises(error, match=words):
        await enabled(make_arm, payload_kg=0.4, collision_level=8)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF


async def test_an_arm_that_does_not_arrive_is_said_to_be_where_it_rests(arm: AuboArcs):
    with pytest.raises(MotionFailed, match=r"rests .* mm and .* deg from the target.*pendant.*`brushloop collect plan"):
        await arm.follow([brush_pose(900.0, 0.0, 250.0)], **QUICK)
    await arm.follow([NEAR], **QUICK)


# ---------------------------------------------------------------- what another client does meanwhile


async def test_an_arm_that_was_moved_is_not_sent_anywhere_until_it_is_taken_up(
    arm: AuboArcs, other: Controller, cabinet: Cabinet
):
    await arm.follow([ABOVE], **QUICK)
    await arm.confirm()
    await other.move_line(ELSEWHERE, 200.0, 800.0)
    await until_settled(other.rest, ELSEWHERE, planned_s=2.0)
    sent = cabinet.taken
    for refused in (arm.follow([LOW], **QUICK), arm.follow([LOW, ABOVE], **QUICK), arm.confirm()):
        with pytest.raises(ArmMoved, match=r"109\.\d mm and 10\.0 deg from where it was left"):
            await refused
    assert cabinet.taken == sent
    assert distance(await arm.take_up(), ELSEWHERE)[0] < 0.05
    await arm.follow([LOW], **QUICK)


async def test_an_arm_that_somebody_moves_right_now_is_not_fought(arm: AuboArcs, other: Controller, cabinet: Cabinet):
    await arm.follow([ABOVE], **QUICK)
    await other.move_line(LOW, 1.0, 800.0)
    sent = cabinet.taken
    for refused in (arm.follow([ELSEWHERE], **QUICK), arm.take_up(), arm.confirm()):
        with pytest.raises(ArmMoved, match="Wait until the arm rests") as caught:
            await refused
        assert caught.value.moving
    assert cabinet.taken == sent, "nothing was queued behind it"
    assert not await other.at_rest(), "and it was not stopped"


TAMPERED: list[tuple[str, dict[str, Any], str]] = [
    ("RobotConfig.setTcpOffset", {"offset": [0.0, 0.0, 0.17, 0.0, 0.0, 0.0]}, r"tool offset is \(0, 0, 170\) mm, "),
    ("RobotConfig.setTcpOffset", {"offset": [0.0, 0.0, 0.18, 0.1, 0.0, 0.0]}, r"\(5.7296, 0, 0\) deg, not \(0, 0, "),
    (
        "RobotConfig.setPayload",
        {"m": 1.0, "cog": [0.0] * 3, "aom": [0.0] * 3, "inertia": [0.0] * 6},
        r"payload is 1 kg, \(0, 0, 0\) mm, not 0 kg",
    ),
    ("RobotConfig.setCollisionLevel", {"level": 1}, "collision level is 1, not 6"),
    ("MotionControl.setSpeedFraction", {"fraction": 0.5}, "speed fraction is 0.5, not 1"),
    ("RobotManage.setOperationalMode", {"mode": "Manual"}, "operational mode is Manual, not Automatic"),
]


@pytest.mark.parametrize(("method", "params", "words"), TAMPERED)
async def test_what_a_press_depends_on_is_read_back_before_each_way_down(
    arm: AuboArcs, other: Controller, cabinet: Cabinet, method: str, params: dict[str, Any], words: str
):
    await arm.follow([ABOVE], **QUICK)
    assert await other.ask(method, **params) == 0
    sent, before = cabinet.taken, cabinet.tool
    for refused in (arm.follow([LOW], **QUICK), arm.follow([ABOVE, LOW], **QUICK), arm.take_up()):
        with pytest.raises(SettingsChanged, match=words):
            await refused
    assert cabinet.taken == sent
    assert cabinet.tool == before
    await other.ask("RobotManage.setOperationalMode", mode="Automatic")
    await arm.enable()  # sets what is configured again; what is not is taken as it is
    await arm.follow([LOW], **QUICK)
    assert distance(cabinet.tool, LOW)[0] < 0.05


async def test_a_safety_stop_is_reported_before_what_it_changes(arm: AuboArcs, other: Controller, cabinet: Cabinet):
    await arm.follow([ABOVE], **QUICK)
    await other.ask("RobotManage.setOperationalMode", mode="Manual")
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe):
        await arm.follow([LOW], **QUICK)


async def test_an_arm_without_power_is_not_as_it_was_left_and_enabling_it_powers_it_again(
    arm: AuboArcs, other: Controller
):
    await arm.follow([ABOVE], **QUICK)
    await other.ask("RobotManage.poweroff")  # takes a moment, in which a request for power is ignored
    for refused in (arm.confirm(), arm.take_up(), arm.follow([LOW], **QUICK)):
        with pytest.raises(NotPowered):
            await refused
    await arm.enable()
    await arm.follow([LOW], **QUICK)


@pytest.mark.parametrize("wrong", [{"v": 0.0}, {"v": math.nan}, {"blend_radius": 0.0005}, {"blend_radius": 2.0}])
async def test_a_cabinet_refuses_a_line_with_a_wrong_argument(
    arm: AuboArcs, other: Controller, cabinet: Cabinet, wrong: dict[str, float]
):
    assert await other.ask("MotionControl.moveLine", **{"pose": to_wire(NEAR), "a": 1.0, "v": 0.1, **wrong}) == -5
    assert cabinet.rests


async def test_a_protective_stop_keeps_the_path_until_a_person_unlocks_and_someone_resumes(
    arm: AuboArcs, other: Controller, cabinet: Cabinet
):
    await other.move_line(NEAR, 100.0, 800.0)
    await asyncio.sleep(0.005)
    cabinet.cabinet.safety_stop()
    await asyncio.sleep(0.1)
    stopped = cabinet.tool
    assert distance(stopped, NEAR)[0] > 1.0
    with pytest.raises(RobotNotSafe):
        await other.move_line(ABOVE, 100.0, 800.0)
    assert cabinet.cabinet.resume() == ReturnCode.BAD_STATE
    cabinet.cabinet.release()
    await asyncio.sleep(0.1)
    assert cabinet.tool == stopped
    cabinet.cabinet.resume()
    await asyncio.sleep(0.1)
    assert cabinet.tool == NEAR


def test_a_tool_that_is_read_back_in_other_angles_is_the_same_tool_and_one_turned_a_little_is_another():
    def tool(*turn_deg: float) -> Settings:
        offset = from_wire([0.0, 0.0, 0.18, *map(math.radians, turn_deg)])
        return Settings(offset, (0.0,) * 4, 6.0, 1.0, "Automatic")

    tool(-180.0, 0.0, 0.0).require("enable", tool(180.0, 0.0, 0.0))
    tool(0.0, 180.0, -150.0).require("enable", tool(180.0, 0.0, 30.0))
    with pytest.raises(SettingsChanged, match=r"\(-179\.99, 0, 0\) deg, not .*\(-?180, 0, 0\)"):
        tool(-179.99, 0.0, 0.0).require("enable", tool(180.0, 0.0, 0.0))


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
        await arm.follow([FAR], **SLOW)
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
        await arm.follow([FAR], **SLOW)
    assert condition in caught.value.condition
    assert caught.value.remedy
    assert cabinet.rests
    left_mm = to_go_mm(cabinet)
    assert 100.0 < left_mm < 200.0
    for attempt in (arm.follow([NEAR], **QUICK), arm.enable()):
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
    await arm.follow([FAR], **QUICK)
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
    move = asyncio.create_task(arm.follow([FAR], **SLOW))
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
        await arm.follow([FAR], **SLOW)
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
    move = asyncio.create_task(arm.follow([FAR], **SLOW))
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
