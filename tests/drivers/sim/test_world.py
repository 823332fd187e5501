"""What the world keeps of a path: presses, ink, marks; whoever looks on changes nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.brush.drag import INK_PER_MM
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.world import INK_PER_PRESS, Press, World

TABLE = Table()
SAFE_Z = TABLE.paper_z_mm + 40.0


def on_paper(x_mm: float, y_mm: float, depth_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """A pose given in the paper frame."""
    yaw = math.radians(TABLE.yaw_deg)
    dx, dy = math.cos(yaw) * x_mm - math.sin(yaw) * y_mm, math.sin(yaw) * x_mm + math.cos(yaw) * y_mm
    x0, y0 = TABLE.origin_mm
    heading = heading_deg + TABLE.yaw_deg
    return brush_pose(x0 + dx, y0 + dy, TABLE.paper_z_mm + depth_mm, heading_deg=heading, tilt_deg=tilt_deg)


def dip() -> list[Pose]:
    return [on_paper(*TABLE.well_mm, z) for z in (40.0, 2.0, 40.0)]


def press(x_mm: float, y_mm: float, depth_mm: float, **lean: float) -> list[Pose]:
    return [on_paper(x_mm, y_mm, z, **lean) for z in (40.0, -depth_mm, 40.0)]


SCRIPT = [*dip(), *press(30.0, 40.0, 11.0), *press(90.0, 70.0, 15.0, heading_deg=33.0, tilt_deg=10.0)]


def drag(*corners_mm: tuple[float, float], depth_mm: float = 8.0) -> list[Pose]:
    """Straight down at the first corner, along all of them, straight up."""
    above = [on_paper(*corner, 40.0) for corner in (corners_mm[0], corners_mm[-1])]
    return [above[0], *(on_paper(*corner, -depth_mm) for corner in corners_mm), above[1]]


L_CORNER = ((40.0, 60.0), (70.0, 60.0), (70.0, 40.0))
STROKES = [*dip(), *press(30.0, 110.0, 11.0), *drag(*L_CORNER), *press(90.0, 110.0, 13.0)]


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


def test_a_contact_that_travels_is_one_drag_and_no_press():
    world = run(STROKES)
    assert len(world.presses) == 2
    (mark,) = world.drags
    assert [(w.x_mm, w.y_mm) for w in mark.path[1:-1]] == [pytest.approx(corner) for corner in L_CORNER]
    assert [w.depth_mm for w in mark.path] == pytest.approx([0.0, 8.0, 8.0, 8.0, 0.0], abs=1e-6)
    assert mark.heading_deg == pytest.approx(0.0, abs=1e-5)
    assert world.version == 3
    # 20 px per 2 mm around the first line, before the leash pulls the patch off it
    rows = slice(round((172.0 - 61.0) * 10), round((172.0 - 59.0) * 10))
    assert (world.paper.density[rows, 420:560] > 0.3).mean() > 0.9


@pytest.mark.parametrize(("step_s", "rate"), [(0.003, 1.0), (0.05, 50.0), (0.71, 1000.0)])
def test_a_drag_depends_neither_on_who_looks_nor_on_the_rate(step_s: float, rate: float):
    alone = run(STROKES)
    watched = run(STROKES, np.arange(0.0, 12.0, step_s).tolist(), rate)
    assert (watched.drags, watched.presses) == (alone.drags, alone.presses)
    assert np.array_equal(watched.paper.density, alone.paper.density)


def test_a_drag_takes_ink_for_landing_and_for_each_mm():
    world = run([*dip(), *drag(*L_CORNER)])
    assert world.drags[0].ink_load == 1.0
    assert world.ink_load == pytest.approx(1.0 - INK_PER_PRESS - INK_PER_MM * 50.0)


@pytest.mark.parametrize(("sideways_mm", "drags"), [(0.4, 0), (0.6, 1)])
def test_a_hair_of_travel_is_still_a_press(sideways_mm: float, drags: int):
    world = run([*dip(), *drag((40.0, 60.0), (40.0 + sideways_mm, 60.0))])
    assert (len(world.presses), len(world.drags)) == (1 - drags, drags)


def test_withdrawing_a_tilted_brush_along_its_own_axis_is_no_drag():
    tilt = math.radians(10.0)
    down = on_paper(40.0, 60.0, -15.0, tilt_deg=10.0)
    out = on_paper(40.0 + 60.0 * math.sin(tilt), 60.0, -15.0 + 60.0 * math.cos(tilt), tilt_deg=10.0)
    world = run([*dip(), on_paper(40.0, 60.0, 40.0, tilt_deg=10.0), down, out])
    assert (len(world.presses), world.drags) == (1, [])


def test_a_drag_that_leaves_the_sheet_is_cut_and_one_beside_it_leaves_nothing():
    world = run([*dip(), *drag((200.0, 60.0), (280.0, 60.0))])
    assert len(world.drags) == 1
    assert world.paper.density[:, -1].any()
    beside = run([*dip(), *drag((270.0, 80.0), (290.0, 80.0))])
    assert beside.drags == []
    assert not beside.paper.density.any()


def test_a_drag_stopped_on_the_way_leaves_its_mark_when_it_lifts():
    world = World(SimConfig())
    for pose in [*dip(), on_paper(40.0, 60.0, 40.0), on_paper(40.0, 60.0, -8.0)]:
        world.motion.add(pose, 200.0, 800.0, 0.0)
    world.motion.advance(100.0)
    world.motion.add(on_paper(90.0, 60.0, -8.0), 10.0, 800.0, 100.0)
    world.motion.stop(2000.0, 2.0, 102.0)  # about 20 mm on
    world.motion.advance(200.0)
    assert world.drags == []
    world.motion.add(on_paper(60.0, 60.0, 40.0), 200.0, 800.0, 200.0)
    world.motion.advance(300.0)
    (mark,) = world.drags
    assert mark.path[-2].x_mm == pytest.approx(60.0, abs=0.5)


def test_a_scripted_flaw_happens_once_and_is_on_the_answer_sheet():
    def play(flaw: Flaw | None) -> World:
        world = World(SimConfig())
        if flaw is not None:
            world.flaws[1] = (flaw, 0.8)
        for pose in [*SCRIPT, *dip(), *press(150.0, 70.0, 15.0)]:
            world.motion.add(pose, 200.0, 800.0, 0.0)
        world.motion.advance(1e4)
        return world

    sound, split = play(None), play(Flaw.SPLIT)
    assert [(p.flaw, p.severity) for p in sound.presses] == [(None, 0.0)] * 3
    assert [(p.flaw, p.severity) for p in split.presses] == [(None, 0.0), (Flaw.SPLIT, 0.8), (None, 0.0)]
    differ = np.nonzero((sound.paper.density != split.paper.density).any(axis=0))[0] / 10.0
    assert 65.0 < differ.min() < differ.max() < 95.0


def test_pressing_on_without_a_dip_goes_wrong_by_itself_and_by_the_seed():
    def named(seed: int) -> list[Flaw | None]:
        world = World(SimConfig(seed=seed))
        marks = [pose for n in range(10) for pose in press(20.0 + 21.0 * n, 70.0 + 40.0 * (n % 2), 13.0)]
        for pose in [*dip(), *marks]:
            world.motion.add(pose, 200.0, 800.0, 0.0)
        world.motion.advance(1e4)
        return [p.flaw for p in world.presses]

    first, second = named(1), named(2)
    assert first[:3] == second[:3] == [None] * 3
    assert Flaw.SPLIT in first + second
    assert Flaw.FAINT in first + second
    assert first[-1] == second[-1] == Flaw.BLANK
    assert named(1) == first != second
