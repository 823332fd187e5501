"""Circles, splines, velocities and servo steps, and who is told that the arm is busy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from drivers.geometry import brush_pose, distance, to_wire
from drivers.sim.arm.kinematics import HOME, LIMITS_DEG

CENTRE = (300.0, -230.0)
START = brush_pose(250.0, -230.0, 260.0)
VIA = brush_pose(300.0, -180.0, 260.0)
END = brush_pose(350.0, -230.0, 260.0)


def circle(on: Any, **more: Any) -> int:
    params = {"a": 1.0, "v": 0.1, "blend_radius": 0.0, "duration": 0.0, **more}
    return on.ask("MotionControl.moveCircle", via_pose=to_wire(VIA), end_pose=to_wire(END), **params)


def test_a_circle_goes_round_at_its_speed_and_ends_where_it_should(on: Any):
    assert circle(on) == 0
    points: list[tuple[float, float, float]] = []
    while on.exec_id != -1:
        points.append(on.world.tool().position_mm)
        on.clock.s += 0.01
    away = [math.dist(p[:2], CENTRE) for p in points]
    assert max(abs(r - 50.0) for r in away) < 1e-6
    assert max(p[1] for p in points) == pytest.approx(-180.0, abs=0.1)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1) / 0.01
    assert steps.max() <= 100.0 + 1e-6
    assert len(points) * 0.01 == pytest.approx(math.pi * 50.0 / 100.0 + 0.1, abs=0.02)
    assert on.off_mm(END) == 0.0


def test_a_tight_circle_is_slower_than_asked(on: Any):
    circle(on, a=0.05)
    on.clock.s += 1.5
    speed = on.ask("RobotState.getTcpSpeed")
    assert math.hypot(*speed[:3]) <= math.sqrt(0.05 * 0.05) + 1e-6


@pytest.mark.parametrize(("mode", "middle_deg"), [(0, -90.0), (1, 15.0), (2, 80.0)])
def test_the_tool_turns_on_a_circle_as_the_mode_says(on: Any, mode: int, middle_deg: float):
    assert on.ask("MotionControl.setCirclePathMode", mode=mode) == 0
    via, end = brush_pose(*VIA.position_mm, heading_deg=80.0), brush_pose(*END.position_mm, heading_deg=30.0)
    on.ask("MotionControl.moveCircle", via_pose=to_wire(via), end_pose=to_wire(end), a=1.0, v=0.1)
    half_s = 0.5 * (math.pi * 50.0 / 100.0 + 0.1)
    on.clock.s += half_s
    want = brush_pose(*VIA.position_mm, heading_deg=middle_deg)
    off_mm, off_deg = distance(on.world.tool(), want)
    assert off_mm < 1e-6
    assert off_deg < 1e-4


def test_points_on_a_line_make_no_circle(on: Any):
    code = on.ask(
        "MotionControl.moveCircle",
        via_pose=to_wire(brush_pose(300.0, -230.0, 260.0)),
        end_pose=to_wire(END),
        a=1.0,
        v=0.1,
    )
    assert code == -5
    assert on.ask("MotionControl.setCirclePathMode", mode=3) == -5


def test_a_spline_runs_through_its_points_once_it_is_ended(on: Any):
    points = [[0.0, *HOME[1:]], [0.1, -0.4, *HOME[2:]], [0.2, -0.2, *HOME[2:]]]
    for q in points:
        assert on.ask("MotionControl.moveSpline", q=q, a=1.0, v=0.3, duration=0.0) == 0
    on.clock.s += 5.0
    assert on.exec_id == -1
    assert on.ask("MotionControl.moveSpline", q=[], a=1.0, v=0.3, duration=0.0) == 0
    seen: list[Any] = []
    while on.exec_id != -1:
        seen.append(on.ask("RobotState.getJointPositions"))
        on.clock.s += 0.01
    for q in points:
        assert min(max(abs(a - b) for a, b in zip(q, p, strict=True)) for p in seen) < 5e-3
    fastest = np.abs(np.diff(seen, axis=0)).max() / 0.01
    assert fastest <= 0.3 * 1.001
    assert on.ask("RobotState.getJointPositions") == pytest.approx(points[-1], abs=1e-6)
    assert on.ask("MotionControl.moveSpline", q=[], a=1.0, v=0.3, duration=0.0) == 13


def test_a_velocity_lasts_until_it_is_stopped(on: Any):
    assert on.ask("MotionControl.speedLine", xd=[0.02, 0.0, 0.0, 0.0, 0.0, 0.0], a=0.1, t=0.0) == 0
    on.clock.s += 1.2
    assert on.ask("RobotState.getTcpSpeed")[:3] == pytest.approx([0.02, 0.0, 0.0], abs=1e-6)
    assert on.ask("RobotManage.getRobotControlMode") == "Speed"
    assert on.world.tool().x_mm - START.x_mm == pytest.approx(20.0 * 1.2 - 0.5 * 20.0 * 0.2)
    assert on.exec_id == 0
    before = on.world.tool().x_mm
    assert on.ask("MotionControl.stopLine", acc=0.2, acc_rot=1.0) == 0
    on.clock.s += 1.0
    assert on.world.tool().x_mm - before == pytest.approx(20.0**2 / (2 * 200.0))
    assert on.exec_id == -1
    assert on.line(START) == 0


def test_a_new_velocity_takes_over_without_a_jump(on: Any):
    on.ask("MotionControl.speedLine", xd=[0.05, 0.0, 0.0, 0.0, 0.0, 0.0], a=0.5, t=0.0)
    on.clock.s += 0.5
    on.world.tool()
    on.ask("MotionControl.speedLine", xd=[0.0, 0.05, 0.0, 0.0, 0.0, 0.0], a=0.5, t=0.0)
    points: list[Any] = []
    for _ in range(100):
        points.append(on.world.tool().position_mm)
        on.clock.s += 0.005
    velocity = np.diff(points, axis=0) / 0.005
    assert velocity[0] == pytest.approx([50.0, 0.0, 0.0], abs=3.0)
    assert velocity[-1] == pytest.approx([0.0, 50.0, 0.0], abs=1e-6)
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() <= 500.0 * 0.005 * 1.01


def test_a_velocity_that_is_not_reached_in_its_time_ends(on: Any):
    on.ask("MotionControl.speedLine", xd=[0.2, 0.0, 0.0, 0.0, 0.0, 0.0], a=0.1, t=0.5)
    on.clock.s += 3.0
    assert on.exec_id == -1
    assert on.world.tool().x_mm - START.x_mm == pytest.approx(2 * 0.5 * 100.0 * 0.5**2)


def test_a_velocity_ends_within_reach(on: Any):
    on.ask("MotionControl.speedLine", xd=[0.2, 0.0, 0.0, 0.0, 0.0, 0.0], a=1.0, t=0.0)
    on.clock.s += 60.0
    assert on.exec_id == -1
    assert 500.0 < on.world.tool().x_mm < 900.0
    assert on.line(START) == 0


def test_joint_velocities_end_within_the_joints_ranges(on: Any):
    assert on.ask("MotionControl.speedJoint", qd=[0.5, 0.0, 0.0, 0.0, 0.0, 0.0], a=2.0, t=0.0) == 0
    before = on.ask("RobotState.getJointPositions")
    on.clock.s += 1.25
    now = on.ask("RobotState.getJointPositions")
    assert on.ask("RobotState.getJointSpeeds") == pytest.approx([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert now[0] - before[0] == pytest.approx(0.5 * 1.25 - 0.5 * 0.5 * 0.25)
    on.clock.s += 60.0
    q = on.ask("RobotState.getJointPositions")
    assert on.exec_id == -1
    assert q[0] == pytest.approx(math.radians(LIMITS_DEG[0]), abs=1e-6)
    assert q[1:] == pytest.approx(before[1:])


def test_moves_velocities_and_servo_steps_do_not_mix(on: Any):
    xd = [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]
    on.line(END)
    on.clock.s += 0.1
    assert on.ask("MotionControl.speedLine", xd=xd, a=0.1, t=0.0) == 3
    assert on.ask("MotionControl.setServoMode", enable=True) == 3
    on.clock.s += 20.0
    on.ask("MotionControl.speedLine", xd=xd, a=0.1, t=0.0)
    assert on.line(START) == 3
    on.ask("RuntimeMachine.abort")
    on.clock.s += 5.0
    assert on.ask("MotionControl.setServoMode", enable=True) == 0
    assert on.line(START) == 3
    assert on.ask("MotionControl.speedLine", xd=xd, a=0.1, t=0.0) == 3
    assert on.ask("MotionControl.setServoModeSelect", mode=0) == 0
    assert on.line(START) == 0


def servo(on: Any, q: Any, t: float = 0.01) -> int:
    return on.ask("MotionControl.servoJoint", q=q, a=0.0, v=0.0, t=t, lookahead_time=0.1, gain=200.0)


def test_servo_steps_are_taken_one_after_the_other_in_their_time(on: Any):
    q = list(on.ask("RobotState.getJointPositions"))
    assert servo(on, q) == -13
    assert on.ask("MotionControl.setServoModeSelect", mode=2) == 0
    assert on.ask("MotionControl.isServoModeEnabled") is True
    for _ in range(20):
        q[0] += 0.005
        assert servo(on, q) == 0
    on.clock.s += 0.1
    assert on.ask("RobotState.getJointPositions")[0] == pytest.approx(q[0] - 0.05)
    on.clock.s += 0.1
    assert on.exec_id == -1
    assert on.ask("RobotState.getJointPositions") == pytest.approx(q)
    assert servo(on, [q[0] + 1.0, *q[1:]]) == -5  # 100 rad/s
    assert servo(on, q, t=0.0) == -5


def test_servo_poses_follow_the_configured_tool(on: Any):
    on.ask("MotionControl.setServoModeSelect", mode=3)
    step = brush_pose(251.0, -230.0, 260.0)
    code = on.ask(
        "MotionControl.servoCartesian", pose=to_wire(step), a=0.0, v=0.0, t=0.02, lookahead_time=0.1, gain=200.0
    )
    assert code == 0
    on.clock.s += 0.01
    assert on.world.tool().x_mm == pytest.approx(250.5)
    on.clock.s += 0.02
    assert on.off_mm(step) == 0.0


@pytest.mark.parametrize("how", ["safety", "stop"])
def test_a_safety_stop_ends_servo_mode_and_a_velocity(on: Any, how: str):
    on.ask("MotionControl.speedLine", xd=[0.02, 0.0, 0.0, 0.0, 0.0, 0.0], a=0.1, t=0.0)
    on.clock.s += 0.5
    on.cabinet.collide() if how == "safety" else on.cabinet.emergency_stop()
    on.clock.s += 1.0
    rest = on.world.tool()
    assert on.exec_id == -1
    on.clock.s += 5.0
    assert on.world.tool() == rest
    if how == "safety":
        on.ask("RobotManage.setUnlockProtectiveStop")
        assert on.ask("RuntimeMachine.resume") == 0
        on.clock.s += 5.0
        assert on.world.tool() == rest


def test_progress_and_times_are_those_of_the_running_move(on: Any):
    on.line(brush_pose(350.0, -230.0, 260.0), blend_radius=0.02)
    on.line(brush_pose(350.0, -130.0, 260.0))
    on.clock.s += 0.55
    assert on.ask("MotionControl.getProgress") == pytest.approx(0.5)
    assert on.ask("MotionControl.isBlending") is False
    assert on.ask("RobotState.getTargetTcpPose")[:2] == pytest.approx([0.35, -0.23])
    on.clock.s += 0.4
    assert on.exec_id == 1
    assert on.ask("MotionControl.isBlending") is True
    left_s = on.ask("MotionControl.getMotionLeftTime", id=1)
    on.clock.s += left_s
    assert on.exec_id == -1
    assert on.ask("MotionControl.getDuration", id=1) == 0.0


@pytest.mark.parametrize(
    "method",
    ["ForceControl.fcEnable", "MotionControl.pathBufferAlloc", "RobotManage.freedrive", "RuntimeMachine.loadProgram"],
)
def test_what_is_not_simulated_says_so(on: Any, method: str):
    assert on.ask(method) == -6


def test_force_control_is_honestly_off(on: Any):
    assert on.ask("ForceControl.isFcEnabled") is False
    assert on.ask("ForceControl.fcDisable") == 0
    assert on.ask("RobotConfig.hasTcpForceSensor") is False
