"""What the cabinet does when asked, on a clock that the test turns."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.geometry import brush_pose, distance, from_wire
from brushloop.drivers.sim.arm.kinematics import HOME

START = brush_pose(250.0, -230.0, 260.0)
NEAR = brush_pose(350.0, -230.0, 260.0)


def test_power_comes_in_steps_that_take_time(off: Any):
    assert (off.mode, off.ask("RobotState.isPowerOn")) == ("PowerOff", False)
    assert off.ask("RobotManage.startup") == 1
    assert off.ask("RobotManage.poweron") == 0
    seen = [off.mode]
    for _ in range(30):
        off.clock.s += 0.05
        seen.append(off.mode)
    assert off.ask("RobotManage.startup") == 0
    for _ in range(30):
        off.clock.s += 0.05
        seen.append(off.mode)
    assert list(dict.fromkeys(seen)) == ["Booting", "PowerOn", "Idle", "BrakeReleasing", "Running"]
    assert off.ask("RobotState.isPowerOn") is True
    assert off.ask("RobotManage.poweroff") == 0
    assert off.mode == "PowerOffing"
    off.clock.s += 1.0
    assert off.mode == "PowerOff"


def test_motion_is_refused_until_running_and_in_a_safety_stop(off: Any):
    assert off.line(NEAR) == -1
    off.run()
    off.cabinet.power.safety = SafetyMode.SAFEGUARD_STOP
    assert off.line(NEAR) == 1
    off.cabinet.power.safety = SafetyMode.REDUCED
    assert off.line(NEAR) == 0


@pytest.mark.parametrize("wrong", [{"v": 0.0}, {"v": math.nan}, {"blend_radius": 0.0005}, {"blend_radius": 2.0}])
def test_a_move_with_a_wrong_argument_is_refused(on: Any, wrong: dict[str, float]):
    assert on.line(NEAR, **wrong) == -5
    assert on.exec_id == -1


def test_moves_queue_up_to_a_limit_and_the_same_pose_is_ignored(on: Any):
    assert on.line(START) == 13
    codes = [on.line(brush_pose(250.0 + k, -230.0, 260.0)) for k in range(1, 67)]
    assert (codes.count(0), codes.count(2)) == (64, 2)
    assert on.ask("MotionControl.getQueueSize") == 64
    on.clock.s += 100.0
    assert on.ask("MotionControl.getQueueSize") == 0


def test_the_speed_fraction_slows_down_what_has_not_begun(on: Any):
    assert on.ask("MotionControl.getSpeedFraction") == 1.0
    on.line(NEAR)
    on.line(START)
    on.clock.s += 0.5
    assert on.ask("MotionControl.setSpeedFraction", fraction=0.5) == 0
    on.clock.s += 0.7  # the first was under way: 100 mm at 100 mm/s and 1 m/s2
    assert on.exec_id == 1
    on.clock.s += 1.9
    assert on.exec_id == 1
    on.clock.s += 0.3
    assert on.exec_id == -1
    for wrong in (0.0, -1.0, 1.1, math.nan):
        assert on.ask("MotionControl.setSpeedFraction", fraction=wrong) == -5
    assert on.ask("MotionControl.getSpeedFraction") == 0.5


def test_a_duration_lengthens_a_move_and_never_shortens_it(on: Any):
    on.line(NEAR, duration=4.0)
    on.clock.s += 3.9
    assert on.exec_id == 0
    on.clock.s += 0.11
    assert on.off_mm(NEAR) == 0.0
    on.line(START, duration=0.1)
    on.clock.s += 1.0
    assert on.exec_id == 1


@pytest.mark.parametrize(
    ("hold", "resume"),
    [
        (("RuntimeMachine.pause", {}), "RuntimeMachine.resume"),
        (("MotionControl.stopMove", {"quick": True, "all_tasks": True}), "MotionControl.startMove"),
    ],
)
def test_a_hold_keeps_the_path_and_resuming_ends_it(on: Any, hold: tuple[str, dict[str, Any]], resume: str):
    on.line(NEAR)
    on.line(START)
    on.clock.s += 0.5
    assert on.ask(hold[0], **hold[1]) == 0
    on.clock.s += 5.0
    assert on.exec_id == 0
    assert on.ask("RobotState.isSteady") is True
    assert on.ask("RuntimeMachine.getRuntimeState") == "Paused"
    assert 40.0 < on.off_mm(NEAR) < 60.0
    assert on.line(NEAR) == 0  # queued behind the rest
    on.clock.s += 5.0
    assert on.ask("MotionControl.getQueueSize") == 3
    assert on.ask(resume) == 0
    seen: list[int] = []
    for _ in range(80):
        on.clock.s += 0.05
        seen.append(on.exec_id)
    assert list(dict.fromkeys(seen)) == [0, 1, 2, -1]
    assert on.off_mm(NEAR) == pytest.approx(0.0)
    assert on.ask("RuntimeMachine.getRuntimeState") == "Stopped"


def test_a_path_can_be_held_again_and_again_even_before_the_arm_has_come_to_rest(on: Any):
    on.line(NEAR)
    on.line(START)
    for _ in range(6):
        on.clock.s += 0.1
        on.ask("RuntimeMachine.pause")
        on.ask("RuntimeMachine.pause")
        on.clock.s += 0.001
        on.ask("RuntimeMachine.resume")
        on.ask("MotionControl.setSpeedFraction", fraction=0.5)
    on.clock.s += 20.0
    assert on.exec_id == -1
    assert on.off_mm(START) == pytest.approx(0.0)
    assert on.cabinet.motion.size == 0


def test_an_abort_ends_a_hold_and_forgets_the_path(on: Any):
    on.line(NEAR)
    on.clock.s += 0.5
    on.ask("RuntimeMachine.pause")
    on.clock.s += 1.0
    assert on.ask("RuntimeMachine.abort") == 0
    assert on.exec_id == -1
    on.ask("RuntimeMachine.resume")
    on.clock.s += 5.0
    assert on.off_mm(NEAR) > 40.0
    assert on.line(START) == 0
    on.clock.s += 5.0
    assert on.off_mm(START) == pytest.approx(0.0)


def test_stopping_a_program_does_not_stop_motion(on: Any):
    on.line(NEAR)
    on.clock.s += 0.5
    assert on.ask("RuntimeMachine.stop") == 0
    on.clock.s += 5.0
    assert on.off_mm(NEAR) == 0.0


def test_a_protective_stop_keeps_the_path_until_a_person_unlocks_and_someone_resumes(on: Any):
    on.line(NEAR)
    on.clock.s += 0.5
    on.cabinet.safety_stop(SafetyMode.PROTECTIVE_STOP)
    on.clock.s += 1.0
    rest_mm = on.off_mm(NEAR)
    assert (on.safety, on.exec_id) == ("ProtectiveStop", 0)
    assert (on.line(START), on.ask("RuntimeMachine.resume")) == (1, 1)
    assert on.ask("RobotManage.setUnlockProtectiveStop") == 0
    on.clock.s += 5.0
    assert (on.safety, on.exec_id) == ("Normal", 0)
    assert on.off_mm(NEAR) == rest_mm
    on.ask("RuntimeMachine.resume")
    on.clock.s += 5.0
    assert on.off_mm(NEAR) == 0.0


def test_a_safeguard_stop_drops_the_path_and_is_not_unlocked_over_the_wire(on: Any):
    on.line(NEAR)
    on.clock.s += 0.5
    on.cabinet.safety_stop(SafetyMode.SAFEGUARD_STOP)
    on.clock.s += 1.0
    assert on.exec_id == -1
    assert on.ask("RobotManage.setUnlockProtectiveStop") == 1
    assert on.safety == "SafeguardStop"


def test_after_an_emergency_stop_a_person_the_board_and_the_power_come_in_that_order(on: Any):
    on.cabinet.emergency_stop()
    assert (on.mode, on.safety) == ("PowerOff", "RobotEmergencyStop")
    assert on.ask("RobotManage.setUnlockProtectiveStop") == 1
    assert on.ask("RobotManage.restartInterfaceBoard") == 1
    on.cabinet.power.button_down = False
    assert on.ask("RobotManage.poweron") == 1
    assert on.ask("RobotManage.restartInterfaceBoard") == 0
    on.run()
    assert (on.mode, on.safety) == ("Running", "Normal")


def test_joints_and_pose_agree_with_the_tool_on(on: Any):
    on.ask("RobotConfig.setTcpOffset", offset=[0.0, 0.0, 0.18, 0.0, 0.0, 0.0])
    joints = on.ask("RobotState.getJointPositions")
    pose, code = on.ask("RobotAlgorithm.forwardKinematics", q=joints)
    assert code == 0
    assert distance(from_wire(pose), on.world.tool())[0] < 1e-3
    back, code = on.ask("RobotAlgorithm.inverseKinematics", qnear=joints, pose=pose)
    assert code == 0
    assert back == pytest.approx(joints, abs=1e-5)
    near, code = on.ask("RobotAlgorithm.inverseKinematics", qnear=joints, pose=[2.0, 0.0, 0.2, math.pi, 0.0, 0.0])
    assert (near, code) == (list(joints), -23)


def test_a_joint_move_is_straight_in_joints_and_ends_where_it_should(on: Any):
    before = on.ask("RobotState.getJointPositions")
    assert on.ask("MotionControl.moveJoint", q=list(HOME), a=1.0, v=0.5) == 0
    on.clock.s += 0.8
    now = on.ask("RobotState.getJointPositions")
    shares = [(b - a) / (c - a) for a, b, c in zip(before, now, HOME, strict=True) if abs(c - a) > 1e-3]
    assert min(shares) > 0.0
    assert max(shares) - min(shares) < 1e-6
    on.clock.s += 20.0
    assert on.ask("RobotState.getJointPositions") == pytest.approx(HOME, abs=1e-5)
    assert on.ask("MotionControl.moveJoint", q=list(HOME), a=1.0, v=0.5) == 13
    assert on.line(START) == 0


def test_a_joint_move_can_be_stopped_and_another_started(on: Any):
    on.ask("MotionControl.moveJoint", q=list(HOME), a=1.0, v=0.5)
    on.clock.s += 0.8
    assert on.ask("MotionControl.stopJoint", acc=5.0) == 0
    on.clock.s += 0.5
    rest = on.ask("RobotState.getJointPositions")
    assert on.exec_id == -1
    assert rest != pytest.approx(HOME, abs=0.01)
    on.ask("MotionControl.moveJoint", q=list(HOME), a=1.0, v=0.5)
    on.clock.s += 20.0
    assert on.ask("RobotState.getJointPositions") == pytest.approx(HOME, abs=1e-5)


def test_what_is_out_of_reach_is_accepted_and_reported_by_a_message(on: Any):
    assert on.ask("Trace.peek", num=10, last_time=0) == []
    on.line(NEAR)
    on.clock.s += 0.5
    assert on.line(brush_pose(950.0, 0.0, 250.0)) == 0
    on.clock.s += 2.0
    assert on.exec_id == -1
    assert on.off_mm(NEAR) > 10.0
    (first,) = on.ask("Trace.peek", num=10, last_time=0)
    assert first["code"] == 30047
    assert on.ask("MotionControl.moveJoint", q=[4.0, 0.0, 0.0, 0.0, 0.0, 0.0], a=1.0, v=1.0) == 0
    (second,) = on.ask("Trace.peek", num=10, last_time=first["timestamp"])
    assert second["timestamp"] > first["timestamp"]


def test_what_is_set_is_what_is_got(on: Any):
    payload = {"m": 0.5, "cog": [0.0, 0.0, 0.05], "aom": [0.0] * 3, "inertia": [0.0] * 6}
    assert on.ask("RobotConfig.setPayload", **payload) == 0
    assert on.ask("RobotConfig.getPayload") == [0.5, [0.0, 0.0, 0.05], [0.0] * 3, [0.0] * 6]
    assert on.ask("RobotConfig.setPayload", **{**payload, "m": 7.0}) == -5
    assert on.ask("RobotConfig.setCollisionLevel", level=8) == 0
    assert on.ask("RobotConfig.setCollisionLevel", level=10) == -5
    assert on.ask("RobotConfig.getCollisionLevel") == 8
    assert on.ask("RobotManage.setOperationalMode", mode="Manual") == 0
    assert on.ask("RobotManage.setOperationalMode", mode="Sideways") == -5
    assert on.ask("RobotManage.getOperationalMode") == "Manual"
    assert on.ask("RobotConfig.setTcpOffset", offset=[0.0] * 5) == -5


def test_the_brush_pushes_back_only_while_it_is_on_the_paper(on: Any):
    table = on.world.config.table
    air_n = on.world.wrench()[2]
    x, y = table.origin_mm[0] - 80.0, table.origin_mm[1] + 100.0
    on.line(brush_pose(x, y, table.paper_z_mm - 10.0), v=1.0)
    on.clock.s += 20.0
    fx, fy, fz, mx, my, mz = on.world.wrench()
    push_n = on.world.reaction.push_n(10.0, 0.0)
    assert push_n > 0.05
    assert [fx, fy, fz] == pytest.approx([0.0, 0.0, air_n - push_n])
    assert [mx, my, mz] == pytest.approx([0.0] * 3)


async def bitten(on: Any) -> None:
    """Return once no watchdog is waiting."""
    async with asyncio.timeout(5.0):
        while on.cabinet._timers:
            await asyncio.sleep(0.01)


async def test_a_watchdog_that_is_not_fed_bites_and_one_that_is_fed_does_not(on: Any):
    on.line(NEAR)
    ends_s: list[float] = []
    for _ in range(4):
        assert on.ask("RegisterControl.setWatchDog", key="wd", timeout=0.1, action=3) == 0
        assert len(on.cabinet._timers) == 1, "the timer set before is cancelled"
        ends_s.append(on.cabinet._timers["wd"].when())
    assert ends_s == sorted(ends_s)
    assert on.safety == "Normal"
    await bitten(on)
    assert on.safety == "ProtectiveStop"
    on.ask("RobotManage.setUnlockProtectiveStop")
    assert not on.cabinet._timers, "it bites once"


async def test_a_watchdog_can_be_disarmed_and_its_actions_differ(on: Any):
    on.ask("RegisterControl.setWatchDog", key="wd", timeout=0.1, action=3)
    on.ask("RegisterControl.setWatchDog", key="wd", timeout=0.1, action=0)
    assert not on.cabinet._timers
    for wrong in ({"timeout": 0.05, "action": 3}, {"timeout": math.nan, "action": 3}, {"timeout": 1.0, "action": 4}):
        assert on.ask("RegisterControl.setWatchDog", key="wd", **wrong) == -5
    for action, held in ((1, True), (2, False)):
        on.line(NEAR if held else START)
        on.clock.s += 0.3
        on.ask("RegisterControl.setWatchDog", key="wd", timeout=0.1, action=action)
        await bitten(on)
        assert on.cabinet.motion.held is held
        on.ask("RuntimeMachine.resume")
    on.cabinet.close()
