"""The delay by one trip of the arm, from when the camera saw it and when it was where."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.collect.photograph.frames import FrameChange
from brushloop.collect.photograph.photographer import ArmPlace, CameraDelay, Look, look

ENTERS = 0.4
"""The share of its way at which the arm comes into the picture; nothing below knows it."""


def way(t_s: float, trip_s: float, stay_s: float) -> float:
    """Parked for a second, there, a stay, and back."""
    begins_s, ends_s = 1.0, 1.0 + trip_s + stay_s
    return min(max((t_s - begins_s) / trip_s, 0.0), 1.0) - min(max((t_s - ends_s) / trip_s, 0.0), 1.0)


def trip(
    delay_s: float, *, period_s: float, phase: float, trip_s: float, stay_s: float
) -> tuple[list[FrameChange], list[ArmPlace]]:
    end_s = 2.0 + 2.0 * trip_s + stay_s
    exposed = np.arange(phase * period_s, end_s, period_s)
    trips = [way(t, trip_s, stay_s) for t in exposed]
    seen = [
        FrameChange(float(t) + delay_s, 0.15 * min(max((w - ENTERS) / 0.3, 0.0), 1.0))
        for t, w in zip(exposed, trips, strict=True)
    ]
    return seen, [ArmPlace(float(t), way(float(t), trip_s, stay_s)) for t in np.arange(0.0, end_s, 0.01)]


@given(
    delay_s=st.floats(0.0, 2.5),
    period_s=st.floats(0.02, 0.125),
    phase=st.floats(0.0, 1.0),
    trip_s=st.floats(0.05, 2.0),
    stay_s=st.floats(0.3, 1.0),
)
def test_the_delay_is_found_within_its_resolution(
    delay_s: float, period_s: float, phase: float, trip_s: float, stay_s: float
):
    found = look(*trip(delay_s, period_s=period_s, phase=phase, trip_s=trip_s, stay_s=stay_s))
    assert found is not None
    assert found.resolution_s <= period_s
    assert found.delay_s == pytest.approx(delay_s, abs=found.resolution_s + 0.03)


def test_a_slow_arm_is_seen_on_its_way_and_gives_the_delay_far_better_than_the_frames_come():
    seen, placed = trip(0.1, period_s=0.125, phase=0.3, trip_s=2.0, stay_s=0.5)
    found = look(seen, placed)
    assert found is not None
    assert found.delay_s == pytest.approx(0.1, abs=0.02)
    assert found.resolution_s < 0.03


def test_what_was_seen_for_longer_than_it_was_there_was_another_trip():
    _, placed = trip(0.1, period_s=0.05, phase=0.0, trip_s=0.1, stay_s=0.3)
    seen, _ = trip(0.1, period_s=0.05, phase=0.0, trip_s=0.1, stay_s=0.9)
    assert look(seen, placed) is None


def test_a_picture_that_does_not_change_shows_nothing():
    seen, placed = trip(0.1, period_s=0.05, phase=0.0, trip_s=0.1, stay_s=0.3)
    assert look([FrameChange(one.arrival_s, 0.0) for one in seen], placed) is None


def test_a_long_silence_shows_nothing():
    seen, placed = trip(0.1, period_s=0.05, phase=0.0, trip_s=0.1, stay_s=3.0)
    assert look(seen, placed) is not None
    assert look([one for one in seen if not 1.5 < one.arrival_s < 3.0], placed) is None


def test_several_looks_are_reported_with_their_spread():
    delay = CameraDelay((Look(0.20, 0.02), Look(0.26, 0.04)))
    assert delay.delay_s == pytest.approx(0.23)
    assert delay.spread_s == pytest.approx(0.06)
    assert delay.bound_s == pytest.approx(0.30)
    assert str(delay) == "230 ± 21 ms (from 2 trips, which differ by 60 ms)"


def test_a_trip_in_which_the_computer_stalled_does_not_make_the_camera_later() -> None:
    delay = CameraDelay((Look(0.41, 0.03), Look(0.65, 0.03), Look(0.42, 0.03), Look(0.40, 0.03)))
    assert delay.delay_s == pytest.approx(0.41)
    assert delay.spread_s == pytest.approx(0.25), "it still counts as unsteady"
    assert delay.bound_s == pytest.approx(0.68), "and a photograph waits for the longest"
    assert CameraDelay((Look(0.40, 0.03), Look(0.65, 0.03))).delay_s == pytest.approx(0.525), "either may have stalled"


@pytest.mark.parametrize(
    ("delays_s", "exact"),
    [
        ((0.53, 0.54, 0.53, 0.53), True),
        ((0.53, 0.54, 0.79, 0.53, 0.53), True),
        ((0.66, 0.67), False),
        ((0.43, 0.42, 0.44), False),
        ((0.54, 0.56, 1.07, 0.55, 0.97, 0.55), False),
        ((0.30, 0.38, 0.34, 0.27), False),
    ],
)
def test_a_delay_is_exact_if_most_of_four_or_more_trips_agree(delays_s: tuple[float, ...], exact: bool) -> None:
    assert CameraDelay(tuple(Look(delay_s, 0.03) for delay_s in delays_s)).exact is exact
