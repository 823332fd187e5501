"""The loopback cabinet on a clock that the test turns: motion, tool, power, safety, watchdogs."""

from __future__ import annotations

import math
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.geometry import brush_pose, distance, from_wire
from brushloop.drivers.sim.kinematics import HOME

START = brush_pose(250.0, -230.0, 260.0)
NEAR = brush_pose(350.0, -230.0, 260.0)


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


def test_a_protective_stop_keeps_the_path_until_a_person_unlocks_and_someone_resumes(on: Any):
    on.line(NEAR)
    on.clock.s += 0.5
    on.cabinet.safety_stop(SafetyMode.PROTECTIVE_STOP)
    on.clock.s += 1.0
    rest_mm = on.off_mm(NEAR)
    assert (on.safety, on.exec_id) == ("ProtectiveStop", 0)
    assert (on.line(START), on.ask("RuntimeMachine.resume")) == (1, 1)
    on.cabinet.release()
    on.clock.s += 5.0
    assert (on.safety, on.exec_id) == ("Normal", 0)
    assert on.off_mm(NEAR) == rest_mm
    on.ask("RuntimeMachine.resume")
    on.clock.s += 5.0
    assert on.off_mm(NEAR) == 0.0


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


def test_nothing_less_takes_the_place_of_an_emergency_stop(on: Any):
    on.cabinet.safety_stop(SafetyMode.ROBOT_EMERGENCY_STOP)
    for mode in (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP):
        on.cabinet.safety_stop(mode)
        assert on.safety == "RobotEmergencyStop"


@pytest.mark.parametrize("mode", [SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SAFEGUARD_STOP])
def test_only_a_person_ends_a_stop_that_drops_the_path(on: Any, mode: SafetyMode):
    on.line(NEAR)
    on.clock.s += 0.5
    on.cabinet.safety_stop(mode)
    powered = mode is SafetyMode.SAFEGUARD_STOP
    assert on.ask("RobotState.isPowerOn") is powered
    assert on.ask("RuntimeMachine.resume") != 0
    assert on.ask("RobotManage.poweron") == (0 if powered else 1)
    assert on.cabinet.release() == mode
    on.run()
    assert (on.safety, on.exec_id) == ("Normal", -1)
    assert on.off_mm(NEAR) > 10.0
    assert on.line(NEAR) == 0


SHEET = brush_pose(460.0 - 80.0, -110.0 + 100.0, 160.0)


def tool(length_mm: float, x_mm: float = 0.0) -> list[float]:
    return [x_mm / 1e3, 0.0, length_mm / 1e3, 0.0, 0.0, 0.0]


def press(on: Any, depth_mm: float) -> None:
    """As an operator would teach it: down to the paper and `depth_mm` deeper, by the configured tool."""
    z_mm = on.world.config.table.paper_z_mm
    for z in (SHEET.z_mm, z_mm - depth_mm, SHEET.z_mm):
        on.line(brush_pose(SHEET.x_mm, SHEET.y_mm, z), v=0.2)
        on.clock.s += 10.0
    on.world.tool()  # the world goes on when someone looks


@pytest.mark.parametrize(("configured_mm", "depth_mm"), [(180.0, 10.0), (175.0, 15.0)])
def test_an_offset_that_is_too_short_presses_deeper_by_as_much(on: Any, configured_mm: float, depth_mm: float):
    assert on.ask("RobotConfig.setTcpOffset", offset=tool(configured_mm)) == 0
    press(on, 10.0)
    [pressed] = on.world.presses
    assert pressed.depth_mm == pytest.approx(depth_mm, abs=1e-6)


def test_the_tip_goes_round_a_wrong_tool_centre_point(on: Any):
    """A turn about the configured point swings a tip that is elsewhere."""
    on.ask("RobotConfig.setTcpOffset", offset=tool(180.0, x_mm=10.0))
    here = from_wire(on.ask("RobotState.getTcpPose"))
    before = on.world.tool()
    assert on.line(brush_pose(*here.position_mm, heading_deg=90.0), v=1.0) == 0
    on.clock.s += 20.0
    assert distance(from_wire(on.ask("RobotState.getTcpPose")), here)[0] < 1e-6
    assert distance(on.world.tool(), before)[0] == pytest.approx(10.0 * math.sqrt(2.0))
