from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arm.motion import STEADY_LAG_S, MotionQueue
from brushloop.drivers.sim.arm.paths import Ramp

ramps = st.builds(Ramp, st.floats(0.01, 800.0), st.floats(0.5, 250.0), st.floats(10.0, 1000.0))


def at(x_mm: float, z_mm: float = 200.0, heading_deg: float = 0.0) -> Pose:
    return brush_pose(x_mm, 0.0, z_mm, heading_deg=heading_deg)


@pytest.fixture
def travelled() -> list[tuple[Pose, Pose]]:
    return []


@pytest.fixture
def queue(travelled: list[tuple[Pose, Pose]]) -> MotionQueue:
    return MotionQueue(at(0.0), lambda start, end: travelled.append((start, end)))


def x_mm(queue: MotionQueue, now_s: float) -> float:
    return queue.pose(now_s).x_mm


def test_a_long_way_is_a_trapezoid():
    ramp = Ramp(length=100.0, speed=50.0, acc=100.0)
    assert ramp.peak == 50.0
    assert ramp.duration_s == pytest.approx(100.0 / 50.0 + 50.0 / 100.0)
    assert ramp.at(0.5) == (pytest.approx(12.5), pytest.approx(50.0))
    assert ramp.at(1.25) == (pytest.approx(50.0), pytest.approx(50.0))


def test_a_short_way_is_a_triangle():
    ramp = Ramp(length=4.0, speed=50.0, acc=100.0)
    assert ramp.peak == pytest.approx(20.0)
    assert ramp.duration_s == pytest.approx(2 * 20.0 / 100.0)
    assert ramp.at(0.2) == (pytest.approx(2.0), pytest.approx(20.0))


@settings(deadline=None)
@given(ramps, st.lists(st.floats(-0.2, 1.2), min_size=2, max_size=30))
def test_distance_only_grows_and_never_faster_than_the_peak(ramp: Ramp, shares: list[float]):
    times = sorted(s * ramp.duration_s for s in shares)
    for a, b in itertools.pairwise(times):
        step = ramp.at(b)[0] - ramp.at(a)[0]
        assert -1e-9 <= step <= ramp.peak * (b - a) * (1 + 1e-9) + 1e-9
        assert 0.0 <= ramp.at(a)[1] <= ramp.peak * (1 + 1e-9)


@settings(deadline=None)
@given(ramps, st.floats(0.0, 1.0))
def test_speed_changes_no_faster_than_the_acceleration(ramp: Ramp, share: float):
    t, dt = share * ramp.duration_s, 1e-3
    assert abs(ramp.at(t + dt)[1] - ramp.at(t)[1]) <= ramp.acc * dt * (1 + 1e-6) + 1e-9


@settings(deadline=None)
@given(ramps)
def test_it_starts_at_nothing_and_ends_at_the_whole_length(ramp: Ramp):
    assert ramp.at(0.0) == (0.0, 0.0)
    assert ramp.at(ramp.duration_s) == (ramp.length, 0.0)


def test_lines_run_in_the_order_in_which_they_came_and_have_rising_ids(
    queue: MotionQueue, travelled: list[tuple[Pose, Pose]]
):
    for x in (100.0, 50.0, 80.0):
        assert queue.add(at(x), 100.0, 1000.0, now_s=0.0)
    seen = [queue.exec_id(k * 0.1) for k in range(40)]
    assert [ident for ident, _ in itertools.groupby(seen)] == [0, 1, 2, -1]
    assert [(a.x_mm, b.x_mm) for a, b in travelled] == [(0.0, 100.0), (100.0, 50.0), (50.0, 80.0)]
    assert x_mm(queue, 4.0) == 80.0


def test_the_arm_is_steady_a_little_after_it_has_arrived(queue: MotionQueue):
    queue.add(at(100.0), 100.0, 1000.0, now_s=0.0)
    end_s = 1.1
    assert queue.exec_id(end_s) == -1
    assert not queue.steady(end_s + 0.5 * STEADY_LAG_S)
    assert queue.steady(end_s + 1.01 * STEADY_LAG_S)


def test_a_line_to_where_the_last_one_ends_is_ignored(queue: MotionQueue):
    assert not queue.add(at(0.0), 100.0, 1000.0, now_s=0.0)
    queue.add(at(10.0), 100.0, 1000.0, now_s=0.0)
    assert not queue.add(at(10.0), 100.0, 1000.0, now_s=0.01)


def test_a_full_queue_says_so(travelled: list[tuple[Pose, Pose]]):
    queue = MotionQueue(at(0.0), lambda *_: None, capacity=2)
    for x in (1.0, 2.0):
        assert not queue.full
        queue.add(at(10.0 * x), 100.0, 1000.0, now_s=0.0)
    assert queue.full


def test_a_turn_on_the_spot_reads_metres_as_radians(queue: MotionQueue):
    queue.add(at(0.0, heading_deg=90.0), 100.0, 1000.0, now_s=0.0)
    assert queue.exec_id(15.0) == 0  # pi / 2 at 0.1 rad/s
    assert queue.exec_id(16.0) == -1


def test_a_stop_decelerates_and_drops_the_rest(queue: MotionQueue, travelled: list[tuple[Pose, Pose]]):
    queue.add(at(100.0), 50.0, 1000.0, now_s=0.0)
    queue.add(at(200.0), 50.0, 1000.0, now_s=0.0)
    before = x_mm(queue, 1.0)
    queue.stop(250.0, 10.0, now_s=1.0)
    rest = before + 50.0**2 / (2 * 250.0)
    assert x_mm(queue, 1.1) == pytest.approx(before + 50.0 * 0.1 - 0.5 * 250.0 * 0.1**2)
    assert x_mm(queue, 1.2001) == x_mm(queue, 99.0) == pytest.approx(rest)
    assert [b.x_mm for _, b in travelled] == [pytest.approx(rest)]


def test_a_second_stop_changes_nothing(queue: MotionQueue):
    queue.stop(250.0, 10.0, now_s=0.0)
    queue.add(at(100.0), 50.0, 1000.0, now_s=0.0)
    queue.stop(250.0, 10.0, now_s=1.0)
    queue.stop(1.0, 10.0, now_s=1.1)
    assert queue.exec_id(1.21) == -1


@pytest.mark.parametrize("asked_s", [1.05, 5.0])
def test_a_line_after_a_stop_starts_where_the_arm_came_to_rest(queue: MotionQueue, asked_s: float):
    queue.add(at(100.0), 50.0, 1000.0, now_s=0.0)
    queue.stop(250.0, 10.0, now_s=1.0)
    queue.add(at(0.0), 50.0, 1000.0, now_s=asked_s)
    path = [queue.pose(1.0 + k * 0.01) for k in range(600)]
    assert max(distance(a, b)[0] for a, b in itertools.pairwise(path)) <= 50.0 * 0.01 + 1e-6
    assert path[-1].x_mm == 0.0


@settings(deadline=None)
@given(st.floats(0.0, 3.0), st.floats(100.0, 5000.0), st.lists(st.floats(0.0, 4.0), max_size=10))
def test_where_a_stopped_arm_rests_does_not_depend_on_who_looked(stop_s: float, acc: float, looks: list[float]):
    def rest(times: list[float]) -> float:
        queue = MotionQueue(at(0.0), lambda *_: None)
        queue.add(at(100.0), 50.0, 200.0, now_s=0.0)
        for t in (t for t in times if t < stop_s):
            queue.pose(t)
        queue.stop(acc, 10.0, stop_s)
        for t in (t for t in times if t >= stop_s):
            queue.pose(t)
        return x_mm(queue, 10.0)

    assert rest(sorted(looks)) == rest([])
