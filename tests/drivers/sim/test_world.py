"""Presses, drags and ink of the simulated world, on a level and on a leaning sheet."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.drivers.sim.brush.paper import PX_PER_MM, Footprint, Paper
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.world import INK_PER_PRESS, Press, World, bent_toward

TABLE = Table()
SAFE_Z = TABLE.paper_z_mm + 40.0


def on_paper(x_mm: float, y_mm: float, above_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """A pose given in the paper frame, `above_mm` above the paper."""
    place = TABLE.to_base(x_mm, y_mm, above_mm)
    return brush_pose(*place, heading_deg=heading_deg + TABLE.yaw_deg, tilt_deg=tilt_deg)


def dip() -> list[Pose]:
    return [on_paper(*TABLE.well_mm, z) for z in (40.0, 2.0, 40.0)]


def press(x_mm: float, y_mm: float, depth_mm: float, **lean: float) -> list[Pose]:
    return [on_paper(x_mm, y_mm, z, **lean) for z in (40.0, -depth_mm, 40.0)]


SCRIPT = [*dip(), *press(30.0, 40.0, 11.0), *press(90.0, 70.0, 15.0, heading_deg=33.0, tilt_deg=10.0)]


def drag(*corners_mm: tuple[float, float], depth_mm: float = 8.0) -> list[Pose]:
    """Straight down at the first corner, along all of them, straight up."""
    above = [on_paper(*corner, 40.0) for corner in (corners_mm[0], corners_mm[-1])]
    return [above[0], *(on_paper(*corner, -depth_mm) for corner in corners_mm), above[1]]


STROKES = [
    *dip(),
    *press(30.0, 110.0, 11.0),
    *drag((40.0, 60.0), (70.0, 60.0), (70.0, 40.0)),
    *press(90.0, 110.0, 13.0),
]


def run(script: Iterable[Pose], looks_s: Iterable[float] = (), flaw: Flaw | None = None, **config: Any) -> World:
    """The world after the script, looked at at the given times of its own clock, with a flaw of the second press."""
    world = World(SimConfig(**config))
    if flaw is not None:
        world.flaws[1] = (flaw, 0.8)
    for pose in script:
        world.motion.add(pose, 200.0, 800.0, now_s=0.0)
    for now_s in looks_s:
        world.motion.pose(now_s)
    world.motion.advance(1e4)
    return world


@pytest.fixture(scope="module")
def pressed() -> World:
    return run(SCRIPT)


def test_every_press_is_on_the_answer_sheet_and_takes_ink_that_a_dip_gives(pressed: World):
    first, second = pressed.presses
    assert (first.x_mm, first.y_mm, first.depth_mm, first.ink_load) == pytest.approx((30.0, 40.0, 11.0, 1.0))
    assert first.tilt_deg == pytest.approx(0.0, abs=1e-5)
    assert (second.x_mm, second.y_mm, second.depth_mm) == pytest.approx((90.0, 70.0, 15.0))
    assert second.ink_load == 1.0 - INK_PER_PRESS
    assert second.tilt_deg == pytest.approx(10.0)
    assert (second.heading_deg - 33.0 + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-5)
    assert run([*SCRIPT, *dip()]).ink_load == 1.0


@pytest.mark.parametrize(("step_s", "rate"), [(0.003, 1.0), (0.05, 50.0), (0.71, 1000.0)])
def test_the_result_depends_neither_on_who_looks_nor_on_the_rate(pressed: World, step_s: float, rate: float):
    watched = run(SCRIPT, np.arange(0.0, 12.0, step_s).tolist(), rate=rate)
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


def test_a_contact_that_travels_is_one_drag_and_no_press():
    world = run(STROKES)
    assert len(world.presses) == 2
    assert world.drags == 1
    assert world.version == 3
    # 20 px per 2 mm around the first line, before the leash pulls the patch off it
    rows = slice(round((172.0 - 61.0) * 10), round((172.0 - 59.0) * 10))
    assert (world.paper.density[rows, 420:560] > 0.3).mean() > 0.9


def test_a_scripted_flaw_happens_once_and_is_on_the_answer_sheet():
    script = [*SCRIPT, *dip(), *press(150.0, 70.0, 15.0)]
    sound, split = run(script), run(script, flaw=Flaw.SPLIT)
    assert [p.flaw for p in sound.presses] == [None] * 3
    assert [p.flaw for p in split.presses] == [None, Flaw.SPLIT, None]
    differ = np.nonzero((sound.paper.density != split.paper.density).any(axis=0))[0] / 10.0
    assert 65.0 < differ.min() < differ.max() < 95.0


def test_pressing_on_without_a_dip_goes_wrong_by_itself_and_by_the_seed():
    def named(seed: int) -> list[Flaw | None]:
        marks = [pose for n in range(10) for pose in press(20.0 + 21.0 * n, 70.0 + 40.0 * (n % 2), 13.0)]
        return [p.flaw for p in run([*dip(), *marks], seed=seed).presses]

    first, second = named(1), named(2)
    assert first[:3] == second[:3] == [None] * 3
    assert Flaw.SPLIT in first + second
    assert Flaw.FAINT in first + second
    assert first[-1] == second[-1] == Flaw.BLANK
    assert named(1) == first != second


LEANING = replace(Table(), slope_deg=(0.6, -0.8))


def test_depth_place_tilt_and_push_of_a_press_are_the_sheets() -> None:
    heights_mm = (60.0, -10.0, 60.0, -8.0)  # straight above a point of the sheet
    poses = [brush_pose(*LEANING.to_base(120.0, 80.0, z), heading_deg=LEANING.yaw_deg) for z in heights_mm]
    world = run(poses, table=LEANING)
    [press] = world.presses
    nx, ny, nz = LEANING.normal
    assert press.depth_mm == pytest.approx(10.0 * nz)
    assert (press.x_mm, press.y_mm) == pytest.approx((120.0 + 10.0 * nz * nx, 80.0 + 10.0 * nz * ny))
    assert press.tilt_deg == pytest.approx(math.degrees(math.acos(nz)), abs=1e-6)  # the brush was vertical
    world.clock._start -= 1e5  # pyright: ignore[reportPrivateUsage]
    push_n = np.array(world.wrench()[:3]) - np.array([0.0, 0.0, SimConfig().hanging_kg * 9.81])
    assert np.linalg.norm(push_n) > 0.05
    # seen by a tool that points straight down, its x along the paper's
    assert push_n / np.linalg.norm(push_n) == pytest.approx([nx, -ny, -nz], abs=1e-9)


def test_a_lean_across_the_set_turns_the_bend_by_45_deg_where_both_carry_the_tip_equally_far() -> None:
    set_deg = Brush(BrushSpec(set_deg=9.0)).set_lean_deg
    assert set_deg == pytest.approx(9.0 / 6.0, rel=0.06), "cut into links, a little more"
    upright = brush_pose(0.0, 0.0, 0.0)
    wrist_deg = bent_toward(upright, 0.0, 90.0, set_deg)
    assert bent_toward(upright, set_deg, wrist_deg + 90.0, set_deg) == pytest.approx(wrist_deg + 45.0)
    assert bent_toward(upright, 20.0 * set_deg, wrist_deg + 90.0, set_deg) == pytest.approx(wrist_deg + 90.0, abs=3.0)


REACH_MM = (6.0, 2.0)
"""Where the middle of the test mark lies in the footprint's own frame."""


def mark(px_per_mm: float = 10.0) -> Footprint:
    """A small disc of ink off the zero-touch point, so that a wrong turn or flip moves it."""
    height, width = round(20 * px_per_mm), round(30 * px_per_mm)
    origin = (10.0 * px_per_mm, 12.0 * px_per_mm)
    x = (np.arange(width) + 0.5 - origin[0]) / px_per_mm
    y = (origin[1] - np.arange(height) - 0.5) / px_per_mm
    inside = (x[None, :] - REACH_MM[0]) ** 2 + (y[:, None] - REACH_MM[1]) ** 2 <= 2.0**2
    return Footprint(inside.astype(np.float32), px_per_mm, origin)


def centroid_mm(paper: Paper) -> tuple[float, float]:
    """In the paper frame, y up."""
    rows, columns = np.indices(paper.density.shape)
    weight = paper.density / paper.density.sum()
    column, row = float((weight * columns).sum()), float((weight * rows).sum())
    return (column + 0.5) / PX_PER_MM, paper.size_y_mm - (row + 0.5) / PX_PER_MM


@pytest.mark.parametrize(("heading_deg", "px_per_mm"), [(0.0, 10.0), (33.0, 16.0), (90.0, 5.0), (180.0, 10.0)])
def test_a_footprint_lands_where_the_brush_touched_turned_to_its_heading(heading_deg: float, px_per_mm: float):
    paper = Paper(80.0, 60.0)
    paper.lay(mark(px_per_mm), 35.0, 25.0, heading_deg)
    cos, sin = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    u, v = REACH_MM
    expected = 35.0 + cos * u - sin * v, 25.0 + sin * u + cos * v
    assert math.dist(centroid_mm(paper), expected) < 0.1


def test_ink_only_adds_up_and_never_beyond_full():
    paper = Paper(60.0, 40.0)
    half = mark()
    half = Footprint(0.5 * half.density, half.px_per_mm, half.origin_px)
    before = paper.density
    for x_mm in (20.0, 20.0, 22.0):
        paper.lay(half, x_mm, 20.0, 0.0)
        assert (paper.density >= before - 1e-6).all()
        assert paper.density.max() <= 1.0
        before = paper.density
    assert before.max() == pytest.approx(0.875)
