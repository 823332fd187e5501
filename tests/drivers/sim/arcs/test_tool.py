"""The true tip is where the steel is, whatever tool centre point was configured."""

from __future__ import annotations

import math
from typing import Any

import pytest

from brushloop.drivers.geometry import brush_pose, distance, from_wire
from brushloop.drivers.sim.arm.kinematics import HOME

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


@pytest.mark.parametrize(("configured_mm", "depth_mm"), [(180.0, 10.0), (175.0, 15.0), (185.0, 5.0)])
def test_an_offset_that_is_too_short_presses_deeper_by_as_much(on: Any, configured_mm: float, depth_mm: float):
    assert on.ask("RobotConfig.setTcpOffset", offset=tool(configured_mm)) == 0
    press(on, 10.0)
    [pressed] = on.world.presses
    assert pressed.depth_mm == pytest.approx(depth_mm, abs=1e-6)


def test_with_a_forgotten_offset_the_controller_speaks_of_the_flange(on: Any):
    on.ask("RobotConfig.setTcpOffset", offset=[0.0] * 6)
    tip, reported = on.world.tool(), from_wire(on.ask("RobotState.getTcpPose"))
    assert reported.z_mm - tip.z_mm == pytest.approx(180.0)
    flange, _ = on.ask("RobotAlgorithm.forwardKinematics", q=on.ask("RobotState.getJointPositions"))
    assert flange[:3] == pytest.approx(on.ask("RobotState.getTcpPose")[:3], abs=1e-6)


def test_configuring_changes_only_what_is_configured(on: Any):
    tip, joints = on.world.tool(), on.ask("RobotState.getJointPositions")
    on.ask("RobotConfig.setTcpOffset", offset=tool(150.0, x_mm=20.0))
    assert on.world.tool() == tip
    assert on.ask("RobotState.getJointPositions") == pytest.approx(joints)
    assert distance(from_wire(on.ask("RobotState.getTcpPose")), tip)[0] == pytest.approx(math.hypot(20.0, 30.0))


def test_the_tip_goes_round_a_wrong_tool_centre_point(on: Any):
    """A turn about the configured point swings a tip that is elsewhere."""
    on.ask("RobotConfig.setTcpOffset", offset=tool(180.0, x_mm=10.0))
    here = from_wire(on.ask("RobotState.getTcpPose"))
    before = on.world.tool()
    assert on.line(brush_pose(*here.position_mm, heading_deg=90.0), v=1.0) == 0
    on.clock.s += 20.0
    assert distance(from_wire(on.ask("RobotState.getTcpPose")), here)[0] < 1e-6
    assert distance(on.world.tool(), before)[0] == pytest.approx(10.0 * math.sqrt(2.0))


def test_joints_mean_the_steel_whatever_is_configured(on: Any):
    ends: list[Any] = []
    for length_mm in (180.0, 120.0):
        on.ask("RobotConfig.setTcpOffset", offset=tool(length_mm))
        on.ask("MotionControl.moveJoint", q=list(HOME), a=1.0, v=0.5)
        on.clock.s += 20.0
        ends.append(on.world.tool())
        on.ask("MotionControl.moveJoint", q=[0.1, *HOME[1:]], a=1.0, v=0.5)
        on.clock.s += 20.0
    assert distance(ends[0], ends[1])[0] < 1e-3


def test_a_move_that_is_under_way_keeps_the_offset_that_it_was_given(on: Any):
    on.line(SHEET)
    on.clock.s += 0.5
    on.ask("RobotConfig.setTcpOffset", offset=tool(100.0))
    on.clock.s += 20.0
    assert on.off_mm(SHEET) == 0.0
