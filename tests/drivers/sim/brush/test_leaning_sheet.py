"""A sheet that leans: contact, depth and tilt are counted along its normal."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.contact import bent_toward, leaning_with
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.world import World

LEANING = replace(Table(), slope_deg=(0.6, -0.8))


def world_after(table: Table, *poses: Pose) -> World:
    world = World(SimConfig(table=table))
    for pose in poses:
        world.motion.add(pose, 200.0, 800.0, now_s=0.0)
    world.motion.advance(1e4)
    return world


def over(table: Table, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    yaw = math.radians(table.yaw_deg)
    x0, y0 = table.origin_mm
    base_x, base_y = x0 + math.cos(yaw) * x_mm - math.sin(yaw) * y_mm, y0 + math.sin(yaw) * x_mm + math.cos(yaw) * y_mm
    return brush_pose(base_x, base_y, z_mm, heading_deg=table.yaw_deg)


def test_the_far_edge_rises_about_x_and_the_right_edge_falls_about_y() -> None:
    table = Table(slope_deg=(1.0, 0.0))
    assert table.surface_z_mm(0.0, 100.0) == pytest.approx(120.0 + 100.0 * math.tan(math.radians(1.0)))
    assert table.surface_z_mm(100.0, 0.0) == 120.0
    assert Table(slope_deg=(0.0, 1.0)).surface_z_mm(100.0, 0.0) == pytest.approx(118.2545, abs=1e-4)
    assert np.linalg.norm(LEANING.normal) == pytest.approx(1.0)


def test_a_level_sheet_is_what_it_was() -> None:
    assert Table().normal == (0.0, 0.0, 1.0)
    assert Table().above_mm(50.0, 60.0, 109.0) == -11.0


@pytest.mark.parametrize("beyond_mm", [-0.01, 0.01])
def test_the_brush_touches_exactly_at_the_plane(beyond_mm: float) -> None:
    z_mm = LEANING.surface_z_mm(200.0, 40.0) - beyond_mm
    up = over(LEANING, 200.0, 40.0, 160.0)
    world = world_after(LEANING, up, over(LEANING, 200.0, 40.0, z_mm), up)
    assert len(world.presses) == (1 if beyond_mm > 0.0 else 0)


def test_depth_place_and_tilt_of_a_press_are_the_sheets() -> None:
    up = over(LEANING, 120.0, 80.0, 180.0)
    world = world_after(LEANING, up, over(LEANING, 120.0, 80.0, LEANING.surface_z_mm(120.0, 80.0) - 10.0), up)
    [press] = world.presses
    nx, ny, nz = LEANING.normal
    assert press.depth_mm == pytest.approx(10.0 * nz)
    assert (press.x_mm, press.y_mm) == pytest.approx((120.0 + 10.0 * nz * nx, 80.0 + 10.0 * nz * ny))
    assert press.tilt_deg == pytest.approx(math.degrees(math.acos(nz)), abs=1e-6)  # the brush was vertical


def test_a_brush_that_leans_with_the_sheet_is_upright_on_it() -> None:
    nx, ny, nz = LEANING.normal
    yaw = math.radians(LEANING.yaw_deg)
    normal = math.cos(yaw) * nx - math.sin(yaw) * ny, math.sin(yaw) * nx + math.cos(yaw) * ny, nz
    tilt_deg, towards_deg = math.degrees(math.acos(nz)), math.degrees(math.atan2(normal[1], normal[0]))
    leaning = brush_pose(500.0, 0.0, 130.0, heading_deg=towards_deg, tilt_deg=tilt_deg)
    upright = brush_pose(500.0, 0.0, 130.0, heading_deg=towards_deg)
    assert leaning_with(leaning, normal).quaternion == pytest.approx(upright.quaternion, abs=1e-9)


def test_the_push_is_along_the_normal() -> None:
    tip = over(LEANING, 120.0, 80.0, LEANING.surface_z_mm(120.0, 80.0) - 8.0)
    world = world_after(LEANING, tip)
    world.clock._start -= 1e5  # pyright: ignore[reportPrivateUsage]
    pressed = np.array(world.wrench()[:3])
    in_the_air = np.array([0.0, 0.0, SimConfig().hanging_kg * 9.81])
    push = pressed - in_the_air
    nx, ny, nz = LEANING.normal
    assert np.linalg.norm(push) > 0.05
    # seen by a tool that points straight down, its x along the paper's
    assert push / np.linalg.norm(push) == pytest.approx([nx, -ny, -nz], abs=1e-9)


def test_a_lean_across_the_set_turns_the_bend_by_45_deg_where_both_carry_the_tip_equally_far() -> None:
    set_deg = Brush(BrushSpec(set_deg=9.0)).set_lean_deg
    assert set_deg == pytest.approx(9.0 / 6.0, rel=0.06), "cut into links, a little more"
    upright = brush_pose(0.0, 0.0, 0.0)
    wrist_deg = bent_toward(upright, 0.0, 90.0, set_deg)
    assert bent_toward(upright, set_deg, wrist_deg + 90.0, set_deg) == pytest.approx(wrist_deg + 45.0)
    assert bent_toward(upright, 20.0 * set_deg, wrist_deg + 90.0, set_deg) == pytest.approx(wrist_deg + 90.0, abs=3.0)


def test_the_well_stands_on_the_leaning_table_and_its_ink_with_it() -> None:
    table = Table(slope_deg=(0.0, -1.0))
    bottom_mm = table.surface_z_mm(*table.well_mm)
    assert bottom_mm > table.paper_z_mm + 4.0
    heights_mm = (bottom_mm + 60.0, bottom_mm + table.ink_level_mm - 2.0, bottom_mm + 60.0)
    world = world_after(table, *(over(table, *table.well_mm, z_mm) for z_mm in heights_mm))
    assert world.ink_load == 1.0
