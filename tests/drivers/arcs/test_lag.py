"""How late poses arrive, from the path that they show and from poses that were asked for."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from brushloop.drivers.arcs.telemetry import LagMeter
from brushloop.drivers.devices import Pose, PoseSample, Stamp
from brushloop.drivers.geometry import brush_pose

Path = Callable[[float], Pose]


@dataclass
class SetClock:
    """A clock that a test sets."""

    s: float = 0.0

    def now_ns(self) -> int:
        return round(1e9 * self.s)


def press(t_s: float) -> Pose:
    """20 mm down at 20 mm/s, half a second of dwell, and the same way up."""
    depth_mm = 20.0 * min(max(t_s, 0.0), 1.0, max(2.5 - t_s, 0.0))
    return brush_pose(400.0, 0.0, 140.0 - depth_mm)


def circle(t_s: float) -> Pose:
    return brush_pose(400.0 + 15.0 * math.cos(2.0 * t_s), 15.0 * math.sin(2.0 * t_s), 118.0)


def lag_ms(
    path: Path, lag_s: float, *, answer_s: float = 0.004, silent: tuple[float, float] = (0.0, 0.0), seconds: float = 4.0
) -> float | None:
    """What is measured where poses arrive this late, 100 times a second, and 40 questions a second are answered."""
    clock, rng = SetClock(), random.Random(7)
    meter = LagMeter(clock)
    for tick in range(round((seconds + lag_s) * 100)):
        t_s = 0.01 * tick
        if not silent[0] < t_s < silent[1]:
            meter.arrived(PoseSample(Stamp(round(1e9 * (100.0 + t_s))), path(t_s - lag_s)))
    for tick in range(round(seconds * 40)):
        t_s = tick / 40 + rng.uniform(0.0, 0.01)
        clock.s = 100.0 + t_s + rng.uniform(0.0, answer_s)
        meter.asked(path(t_s), answer_s)
    return meter.lag_ms()


@pytest.mark.parametrize("path", [press, circle])
@pytest.mark.parametrize("lag_s", [0.0, 0.12, 0.8, 2.0])
def test_the_lag_is_measured_to_a_few_milliseconds(path: Path, lag_s: float):
    assert lag_ms(path, lag_s) == pytest.approx(1e3 * lag_s, abs=15.0)


def test_on_a_slow_network_it_is_known_to_half_of_the_time_of_an_answer():
    assert lag_ms(press, 0.3, answer_s=0.04) == pytest.approx(300.0, abs=25.0)


def test_a_computer_that_was_busy_for_a_while_does_not_count_as_a_lag():
    assert lag_ms(press, 0.0, silent=(0.3, 0.8)) == pytest.approx(0.0, abs=15.0)


@pytest.mark.parametrize("answer_s", [0.2])
def test_from_answers_that_took_long_nothing_is_concluded(answer_s: float):
    assert lag_ms(press, 0.0, answer_s=answer_s) is None


def test_an_arm_at_rest_shows_no_lag():
    assert lag_ms(lambda _: brush_pose(400.0, 0.0, 140.0), 0.8) is None


def test_poses_of_another_path_are_not_compared():
    clock = SetClock(100.0)
    meter = LagMeter(clock)
    for tick in range(400):
        clock.s = 100.0 + 0.01 * tick
        meter.arrived(PoseSample(Stamp(clock.now_ns()), brush_pose(400.0, 0.0, 140.0)))
        meter.asked(circle(0.01 * tick), 0.001)
    assert meter.lag_ms() is None
