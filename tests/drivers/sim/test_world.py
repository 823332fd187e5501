"""What the world keeps of a path: presses, ink, marks; whoever looks on changes nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest

from drivers.geometry import brush_pose
from drivers.samples import Pose
from drivers.sim.config import SimConfig, Table
from drivers.sim.world import INK_PER_PRESS, Press, World

TABLE = Table()
SAFE_Z = TABLE.paper_z_mm + 40.0


def on_paper(x_mm: float, y_mm: float, height_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """A pose given in the paper frame."""
    yaw = math.radians(TABLE.yaw_deg)
    dx, dy = math.cos(yaw) * x_mm - math.sin(yaw) * y_mm, math.sin(yaw) * x_mm + math.cos(yaw) * y_mm
    x0, y0 = TABLE.origin_mm
    heading = heading_deg + TABLE.yaw_deg
    return brush_pose(x0 + dx, y0 + dy, TABLE.paper_z_mm + height_mm, heading_deg=heading, tilt_deg=tilt_deg)


def dip() -> list[Pose]:
    return [on_paper(*TABLE.well_mm, z) for z in (40.0, 2.0, 40.0)]


def press(x_mm: float, y_mm: float, depth_mm: float, **lean: float) -> list[Pose]:
    return [on_paper(x_mm, y_mm, z, **lean) for z in (40.0, -depth_mm, 40.0)]


SCRIPT = [*dip(), *press(30.0, 40.0, 11.0), *press(90.0, 70.0, 15.0, heading_deg=33.0, tilt_deg=10.0)]


def run(script: list[Pose], looks_s: Iterable[float] = (), rate: float = 1.0) -> World:
    """The world after the script, looked at at the given times of its own clock."""
    world = World(SimConfig(rate=rate))
    for pose in script:
        world.motion.add(pose, 200.0, 800.0, now_s=0.0)
    for now_s in looks_s:
        world.motion.pose(now_s)
    world.motion.advance(1e4)
    return world


@pytest.fixture(scope="module")
def pressed() -> World:
    return run(SCRIPT)


def test_every_press_is_on_the_answer_sheet_as_it_really_happened(pressed: World):
    first, second = pressed.presses
    assert (first.x_mm, first.y_mm, first.depth_mm) == pytest.approx((30.0, 40.0, 11.0))
    assert first.tilt_deg == pytest.approx(0.0, abs=1e-5)
    assert (second.x_mm, second.y_mm, second.depth_mm) == pytest.approx((90.0, 70.0, 15.0))
    assert second.tilt_deg == pytest.approx(10.0)
    assert (second.heading_deg - 33.0 + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-5)


def test_a_press_takes_ink_and_a_dip_fills_the_brush(pressed: World):
    assert [p.ink_load for p in pressed.presses] == [1.0, 1.0 - INK_PER_PRESS]
    assert run([*SCRIPT, *dip()]).ink_load == 1.0


def test_a_dry_brush_leaves_a_press_but_less_ink(pressed: World):
    dry = run(SCRIPT[3:6])
    assert dry.presses[0].ink_load == 0.0
    wet = run(SCRIPT[:6])
    assert dry.paper.density.sum() < wet.paper.density.sum()


def test_a_path_above_the_paper_leaves_nothing():
    world = run([on_paper(x, 40.0, 0.0) for x in (30.0, 60.0)])
    assert world.presses == []
    assert not world.paper.density.any()


def test_a_press_beside_the_sheet_leaves_nothing():
    assert run(press(-20.0, 40.0, 10.0)).presses == []


@pytest.mark.parametrize(("step_s", "rate"), [(0.003, 1.0), (0.05, 50.0), (0.71, 1000.0)])
def test_the_result_depends_neither_on_who_looks_nor_on_the_rate(pressed: World, step_s: float, rate: float):
    watched = run(SCRIPT, np.arange(0.0, 12.0, step_s).tolist(), rate)
    assert watched.presses == pressed.presses
    assert np.array_equal(watched.paper.density, pressed.paper.density)
    assert watched.version == pressed.version == 2


def test_a_brush_that_was_stopped_on_the_paper_leaves_its_mark_when_it_lifts():
    world = World(SimConfig())
    world.motion.add(on_paper(30.0, 40.0, 40.0), 200.0, 800.0, 0.0)
    world.motion.advance(100.0)
    world.motion.add(on_paper(30.0, 40.0, -20.0), 20.0, 800.0, 100.0)
    world.motion.stop(2000.0, 2.0, 102.5)  # about 10 mm deep
    world.motion.advance(200.0)
    assert world.presses == []
    world.motion.add(on_paper(30.0, 40.0, 40.0), 200.0, 800.0, 200.0)
    world.motion.advance(300.0)
    (mark,) = world.presses
    assert isinstance(mark, Press)
    assert 8.0 < mark.depth_mm < 12.0


def test_equal_seeds_give_equal_sheets_and_another_seed_another(pressed: World):
    assert np.array_equal(run(SCRIPT).paper.density, pressed.paper.density)
    other = World(SimConfig(seed=2))
    for pose in SCRIPT:
        other.motion.add(pose, 200.0, 800.0, 0.0)
    other.motion.advance(1e4)
    assert not np.array_equal(other.paper.density, pressed.paper.density)
