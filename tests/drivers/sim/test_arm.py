"""The loopback arm: its joints, its path of lines, rounded corners, stops and holds.

Time is turned by the tests.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose, distance, from_wire
from brushloop.drivers.sim.kinematics import HOME, LIMITS_DEG, forward, inverse, pose_of
from brushloop.drivers.sim.motion import MotionQueue

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
    assert (cornered.exec_id(20.0), cornered.size) == (-1, 0)
    for (_, a), (b, _) in itertools.pairwise(travelled):
        assert distance(a, b)[0] < 1e-6
