"""The simulated world: its arm's joints and path, the brush and what it leaves, the presses and ink around it.

Time is turned by the tests.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.brushes import FROZEN
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose, distance, from_wire
from brushloop.drivers.loopback import RigRefused
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Flaw, Waypoint
from brushloop.drivers.sim.brush.brush_file import LIKE_TABLE_2, load_brush
from brushloop.drivers.sim.brush.footprint import PX_PER_MM, Footprint
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.kinematics import HOME, LIMITS_DEG, forward, inverse, pose_of
from brushloop.drivers.sim.motion import MotionQueue
from brushloop.drivers.sim.world import INK_PER_PRESS, Paper, Press, World, bent_toward

PRESSED = (
    (3986.908, 3129.639, 3100.391),
    (4034.102, 3255.779, 2817.457),
    (4272.797, 3165.911, 1665.903),
    (4235.855, 3262.018, 1500.447),
    (3842.285, 2882.832, 2868.087),
    (10297.543, 8338.703, 7977.463),
)
"""Ink of a press, a drag and a press with a flaw of each frozen brush and of the paper's, as they always were."""
PUSHED_N = (0.122442, 0.140344, 0.128596, 0.257277, 0.080573, 0.036874)
"""Force of that press."""


def test_the_frozen_brushes_and_the_papers_press_and_draw_what_they_always_did() -> None:
    # the bytes agreed too; another processor may round the last bit differently
    ink: list[list[float]] = []
    force_n: list[float] = []
    brushes, flaws = (*FROZEN, load_brush(Path(LIKE_TABLE_2)).brush), (*Flaw, Flaw.SPLIT, Flaw.SPLIT)
    for spec, flaw in zip(brushes, flaws, strict=True):
        brush = Brush(spec)
        press = brush.press(12.0, 5.0, ink_load=0.8, press_seed=3)
        flawed = brush.press(9.0, 0.0, ink_load=1.0, press_seed=4, flaw=flaw, severity=0.7)
        path = [Waypoint(0, 0, 0), Waypoint(0, 0, 5), Waypoint(12, 4, 5)]
        drag = brush.drag(path, 0, 0, ink_load=1.0, press_seed=1)
        force_n.append(float(brush.push_n(12.0, 5.0)[-1]))
        ink.append([float(mark.density.sum(dtype=float)) for mark in (press, drag, flawed)])
    assert ink == [pytest.approx(row, rel=1e-5) for row in PRESSED]
    assert force_n == pytest.approx(PUSHED_N, rel=1e-4)


def test_without_ink_or_touch_a_press_leaves_nothing_and_one_out_of_range_is_refused() -> None:
    brush = Brush(BrushSpec())

    def ink(**change: float) -> float:
        command = {"depth_mm": 15.0, "tilt_deg": 5.0, "ink_load": 1.0} | change
        return float(brush.press(**command, press_seed=1).density.sum())

    assert ink(depth_mm=0.0) == ink(ink_load=0.0) == 0.0 < ink()
    with pytest.raises(ValueError, match=r"depth_mm = nan is outside -inf \.\. 43\."):
        ink(depth_mm=math.nan)
    with pytest.raises(ValueError, match=r"ink_load = 1\.2 is outside 0 \.\. 1"):
        ink(ink_load=1.2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("friction = 3.0", r"brush: friction = 3 is outside 0 \.\. 0\.8"),
        ("radius_mm = 19.0\nlength_mm = 40.0", r"brush: length_mm = 40 is outside 57 \.\. 120"),
        ("friction = ", "is not TOML"),
        ("# " + 300_000 * "x", "is larger than 262144 bytes"),
    ],
)
def test_a_brush_out_of_range_is_refused_with_file_field_and_range(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "brush.toml"
    path.write_text(f'name = "any"\n[brush]\n{text}\n')
    with pytest.raises(RigRefused, match=message) as refused:
        load_brush(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


TABLE = Table()


def on_paper(x_mm: float, y_mm: float, above_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """A pose given in the paper frame, `above_mm` above the paper."""
    place = TABLE.to_base(x_mm, y_mm, above_mm)
    return brush_pose(*place, heading_deg=heading_deg + TABLE.yaw_deg, tilt_deg=tilt_deg)


def dip() -> list[Pose]:
    return [on_paper(*TABLE.well_mm, z) for z in (40.0, 2.0, 40.0)]


def press(x_mm: float, y_mm: float, depth_mm: float, **lean: float) -> list[Pose]:
    return [on_paper(x_mm, y_mm, z, **lean) for z in (40.0, -depth_mm, 40.0)]


SCRIPT = [*dip(), *press(30.0, 40.0, 11.0), *press(90.0, 70.0, 15.0, heading_deg=33.0, tilt_deg=10.0)]


def run(script: Iterable[Pose], looks_s: Iterable[float] = (), **config: Any) -> World:
    """The world after the script, looked at at the given times of its own clock."""
    world = World(SimConfig(**config))
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


@pytest.mark.parametrize(("step_s", "rate"), [(0.01, 1.0), (0.71, 1000.0)])
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
    drag = [on_paper(x_mm, y_mm, -8.0) for x_mm, y_mm in ((40.0, 60.0), (70.0, 60.0), (70.0, 40.0))]
    world = run([*dip(), *press(30.0, 110.0, 11.0), on_paper(40.0, 60.0, 40.0), *drag, on_paper(70.0, 40.0, 40.0)])
    assert (len(world.presses), world.drags, world.version) == (1, 1, 2)
    # 20 px per 2 mm around the first line, before the leash pulls the patch off it
    rows = slice(round((172.0 - 61.0) * 10), round((172.0 - 59.0) * 10))
    assert (world.paper.density[rows, 420:560] > 0.3).mean() > 0.9


def test_pressing_on_without_a_dip_goes_wrong_by_itself_and_by_the_seed():
    def named(seed: int) -> list[Flaw | None]:
        marks = [pose for n in range(10) for pose in press(20.0 + 21.0 * n, 70.0 + 40.0 * (n % 2), 13.0)]
        return [p.flaw for p in run([*dip(), *marks], seed=seed).presses]

    first, second = named(1), named(2)
    assert first[:3] == second[:3] == [None] * 3
    assert Flaw.SPLIT in first + second
    assert first[-1] is second[-1] is None, "without ink there is nothing to split"
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


def mark(density: float) -> Footprint:
    """A small square of ink off the zero-touch point, so that a wrong turn or flip moves it."""
    image = np.zeros((200, 300), np.float32)
    image[80:120, 140:180] = density
    return Footprint(image, PX_PER_MM, (100.0, 120.0))


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 90.0, 180.0])
def test_a_footprint_lands_where_the_brush_touched_turned_to_its_heading(heading_deg: float):
    paper = Paper(80.0, 60.0)
    paper.lay(mark(1.0), 35.0, 25.0, heading_deg)
    cos, sin = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    u, v = REACH_MM
    expected = 35.0 + cos * u - sin * v, 25.0 + sin * u + cos * v
    rows, columns = (np.average(axis, weights=paper.density) + 0.5 for axis in np.indices(paper.density.shape))
    assert math.dist((columns / PX_PER_MM, paper.size_y_mm - rows / PX_PER_MM), expected) < 0.1


def test_ink_only_adds_up_and_never_beyond_full():
    paper = Paper(60.0, 40.0)
    for x_mm, most in ((20.0, 0.5), (20.0, 0.75), (22.0, 0.875)):
        before = paper.density
        paper.lay(mark(0.5), x_mm, 20.0, 0.0)
        assert (paper.density >= before - 1e-6).all()
        assert paper.density.max() == pytest.approx(most)


# ---------------------------------------------------------------- the arm: joints, rounded corners, stops and holds

joints = st.tuples(*(st.floats(-2.8, 2.8) for _ in range(6)))


def test_the_home_position_is_where_the_maker_says():
    off_mm, off_deg = distance(pose_of(forward(HOME)), from_wire([0.5489, -0.1215, 0.2632, math.pi, 0.0, math.pi / 2]))
    assert off_mm < 0.1
    assert off_deg < 1e-4


@given(joints, st.tuples(*(st.floats(-0.1, 0.1) for _ in range(6))))
def test_what_the_inverse_finds_is_right(q: tuple[float, ...], off: tuple[float, ...]):
    solution = inverse(forward(q), [a + b for a, b in zip(q, off, strict=True)])
    if solution is not None:  # near a singular position it may give up
        assert np.allclose(forward(solution), forward(q), atol=1e-6)
        assert all(abs(v) <= math.radians(limit) for v, limit in zip(solution, LIMITS_DEG, strict=True))


V, A = 100.0, 1000.0
DT_S = 0.004


def at(x_mm: float, y_mm: float = 0.0, heading_deg: float = 0.0) -> Pose:
    return brush_pose(x_mm, y_mm, 200.0, heading_deg=heading_deg)


START, CORNER, BEYOND = at(0.0), at(100.0), at(100.0, 100.0)


def with_corner(on_path: Callable[[Pose, Pose], object] = lambda *_: None) -> MotionQueue:
    """Two lines at a right angle, of which the first may be left 20 mm before its end."""
    queue = MotionQueue(START, on_path)
    queue.add(CORNER, V, A, 0.0, blend_mm=20.0)
    queue.add(BEYOND, V, A, 0.0)
    return queue


def walked(queue: MotionQueue, until_s: float, dt_s: float = DT_S, begin_s: float = 0.0) -> np.ndarray:
    """Positions, one every `dt_s`."""
    return np.array([queue.pose(t).position_mm for t in np.arange(begin_s, until_s, dt_s)])


def speeds(walk: np.ndarray, dt_s: float = DT_S) -> np.ndarray:
    return np.linalg.norm(np.diff(walk, axis=0), axis=1) / dt_s


def assert_on_the_corners_path(walk: np.ndarray) -> None:
    path = walked(with_corner(), 4.0)
    for point in walk[::30]:
        assert np.linalg.norm(path - point, axis=1).min() < 0.4


def test_a_turn_on_the_spot_reads_metres_as_radians():
    queue = MotionQueue(START, lambda *_: None)
    queue.add(at(0.0, heading_deg=90.0), 100.0, 1000.0, now_s=0.0)
    assert queue.exec_id(15.0) == 0  # pi / 2 at 0.1 rad/s
    assert queue.exec_id(16.0) == -1


def test_a_corner_is_rounded_within_its_radius_and_taken_without_a_rest():
    walk = walked(with_corner(), 2.5)
    near_mm = np.linalg.norm(walk - CORNER.position_mm, axis=1)
    assert 3.0 < near_mm.min() < 20.0
    off_the_lines = np.minimum(np.abs(walk[:, 1]), np.abs(walk[:, 0] - 100.0))
    assert near_mm[off_the_lines > 1e-6].max() <= 20.0 + 1e-6
    assert speeds(walk)[near_mm[:-1] < 20.0].min() > 60.0
    assert tuple(walk[-1]) == BEYOND.position_mm


ways = st.lists(
    st.tuples(st.floats(-80.0, 80.0), st.floats(-80.0, 80.0), st.floats(0.0, 60.0), st.floats(60.0, 200.0)),
    min_size=2,
    max_size=6,
)


@given(ways)
def test_no_way_is_taken_faster_or_harder_than_allowed_and_all_of_them_arrive(
    way: Sequence[tuple[float, float, float, float]],
):
    queue, coarse_s = MotionQueue(START, lambda *_: None), 4 * DT_S
    for x, y, blend, v in way:
        queue.add(at(x, y), v, A, 0.0, blend_mm=blend)
    walk = walked(queue, max(queue._knots[-1].at_s, 0.0) + 0.1, coarse_s)
    assert speeds(walk, coarse_s).max() <= max(v for *_, v in way) * (1 + 1e-6)
    change = np.linalg.norm(np.diff(walk, n=2, axis=0), axis=1) / coarse_s**2
    # a straight piece slows down while the corner bends at an even speed: never both at once
    assert change.max() <= A * 1.02 + 1e-3
    x, y, *_ = way[-1]
    assert np.linalg.norm(walk[-1, :2] - (x, y)) < 1e-3


@pytest.mark.parametrize(("stop_s", "acc"), [(0.3, 50.0), (0.87, 50.0), (0.87, 5000.0)])
def test_a_stop_follows_the_path_through_the_corner(stop_s: float, acc: float):
    cornered = with_corner()
    cornered.pose(stop_s)
    cornered.stop(acc, 10.0, stop_s)
    walk = walked(cornered, 6.0, begin_s=stop_s)
    assert np.all(np.diff(speeds(walk)) <= 0.03 * V)
    assert speeds(walk)[-1] == 0.0
    assert_on_the_corners_path(walk)
    assert cornered.exec_id(6.0) == -1


@pytest.mark.parametrize(("hold_s", "acc"), [(0.05, 2000.0), (0.86, 200.0), (0.86, 2000.0), (1.1, 2000.0)])
def test_a_path_held_anywhere_goes_on_along_itself(hold_s: float, acc: float):
    travelled: list[tuple[Pose, Pose]] = []
    cornered = with_corner(lambda start, end: travelled.append((start, end)))
    cornered.pose(hold_s)
    cornered.hold(acc, 10.0, hold_s)
    assert cornered.exec_id(8.0) in (0, 1)
    assert cornered.steady(8.0)
    cornered.resume(8.0)
    walk = walked(cornered, 14.0, begin_s=8.0)
    assert np.linalg.norm(walk[-1] - BEYOND.position_mm) < 1e-6
    assert speeds(walk).max() <= V * (1 + 1e-6)
    assert_on_the_corners_path(walk)
    assert (cornered.exec_id(20.0), cornered.size(20.0)) == (-1, 0)
    for (_, a), (b, _) in itertools.pairwise(travelled):
        assert distance(a, b)[0] < 1e-6
