"""What is set and checked when an arm is enabled, and what must still be so before each line that is sent."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import Controller, ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.arcs.motion import until_settled
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import Settings
from brushloop.drivers.errors import (
    ArmMoved,
    MotionError,
    MotionFailed,
    MotionRefused,
    NotPowered,
    RobotNotSafe,
    SettingsChanged,
)
from brushloop.drivers.geometry import brush_pose, distance, from_wire, lean, to_wire
from brushloop.drivers.sim.kinematics import forward, pose_of
from tests.drivers.arcs.conftest import NEAR, QUICK, Cabinet, MakeArm, enabled

ABOVE, LOW = brush_pose(300.0, -200.0, 200.0), brush_pose(300.0, -200.0, 130.0)
ELSEWHERE = brush_pose(340.0, -180.0, 100.0, tilt_deg=10.0)


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
    await arm.move(NEAR, **QUICK)
    joints = box.motion.near_joints(cabinet.tool)
    flange = from_wire(box.fk({"q": [*joints]})[0])
    assert distance(flange, NEAR)[0] < 0.1
    assert lean(pose_of(forward(joints)))[0] == pytest.approx(2.5, abs=0.05)


async def test_reduced_mode_and_a_cabinet_without_operational_modes_are_allowed(make_arm: MakeArm, cabinet: Cabinet):
    cabinet.cabinet.operational_mode = "Disabled"
    cabinet.cabinet.power.safety = SafetyMode.REDUCED
    await (await enabled(make_arm)).move(NEAR, **QUICK)


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
        await arm.move(brush_pose(900.0, 0.0, 250.0), **QUICK)
    await arm.move(NEAR, **QUICK)


# ---------------------------------------------------------------- what another client does meanwhile


async def test_an_arm_that_was_moved_is_not_sent_anywhere_until_it_is_taken_up(
    arm: AuboArcs, other: Controller, cabinet: Cabinet
):
    await arm.move(ABOVE, **QUICK)
    await arm.confirm()
    await other.move_line(ELSEWHERE, 200.0, 800.0)
    await until_settled(other.rest, ELSEWHERE, planned_s=2.0)
    sent = cabinet.taken
    for refused in (arm.move(LOW, **QUICK), arm.follow([LOW, ABOVE], **QUICK), arm.confirm()):
        with pytest.raises(ArmMoved, match=r"109\.\d mm and 10\.0 deg from where it was left"):
            await refused
    assert cabinet.taken == sent
    assert distance(await arm.take_up(), ELSEWHERE)[0] < 0.05
    await arm.move(LOW, **QUICK)


async def test_an_arm_that_somebody_moves_right_now_is_not_fought(arm: AuboArcs, other: Controller, cabinet: Cabinet):
    await arm.move(ABOVE, **QUICK)
    await other.move_line(LOW, 1.0, 800.0)
    sent = cabinet.taken
    for refused in (arm.move(ELSEWHERE, **QUICK), arm.take_up(), arm.confirm()):
        with pytest.raises(ArmMoved, match="Wait until it rests") as caught:
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
    await arm.move(ABOVE, **QUICK)
    assert await other.ask(method, **params) == 0
    sent, before = cabinet.taken, cabinet.tool
    for refused in (arm.move(LOW, **QUICK), arm.follow([ABOVE, LOW], **QUICK), arm.take_up()):
        with pytest.raises(SettingsChanged, match=words):
            await refused
    assert cabinet.taken == sent
    assert cabinet.tool == before
    await other.ask("RobotManage.setOperationalMode", mode="Automatic")
    await arm.enable()  # sets what is configured again; what is not is taken as it is
    await arm.move(LOW, **QUICK)
    assert distance(cabinet.tool, LOW)[0] < 0.05


async def test_a_safety_stop_is_reported_before_what_it_changes(arm: AuboArcs, other: Controller, cabinet: Cabinet):
    await arm.move(ABOVE, **QUICK)
    await other.ask("RobotManage.setOperationalMode", mode="Manual")
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe):
        await arm.move(LOW, **QUICK)


async def test_an_arm_without_power_is_not_as_it_was_left_and_enabling_it_powers_it_again(
    arm: AuboArcs, other: Controller
):
    await arm.move(ABOVE, **QUICK)
    await other.ask("RobotManage.poweroff")  # takes a moment, in which a request for power is ignored
    for refused in (arm.confirm(), arm.take_up(), arm.move(LOW, **QUICK)):
        with pytest.raises(NotPowered):
            await refused
    await arm.enable()
    await arm.move(LOW, **QUICK)


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
