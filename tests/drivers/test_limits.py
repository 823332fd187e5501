import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceError, LimitExceeded
from drivers.geometry import brush_pose, from_wire, to_wire
from drivers.limits import Limits
from drivers.samples import Pose

LIMITS = Limits((200.0, 640.0), (-260.0, 260.0), (95.0, 400.0), tilt_deg=15.0, speed_mm_s=250.0, acc_mm_s2=1000.0)
INSIDE: dict[str, float] = {"x": 400.0, "y": 0.0, "z": 200.0, "tilt": 5.0, "speed": 100.0, "acceleration": 500.0}
RANGES = {
    "x": (200.0, 640.0),
    "y": (-260.0, 260.0),
    "z": (95.0, 400.0),
    "tilt": (0.0, 15.0),
    "speed": (0.1, 250.0),
    "acceleration": (1.0, 1000.0),
}


def check(**change: float) -> None:
    at: dict[str, Any] = {**INSIDE, **change}
    pose = brush_pose(at["x"], at["y"], at["z"], heading_deg=70.0, tilt_deg=at["tilt"])
    LIMITS.check("robot", pose, speed_mm_s=at["speed"], acc_mm_s2=at["acceleration"])


@pytest.mark.parametrize("field", RANGES)
def test_both_ends_of_every_range_are_inside(field: str):
    for bound in RANGES[field]:
        check(**{field: bound})


@pytest.mark.parametrize("field", RANGES)
def test_a_step_beyond_either_end_is_refused_by_name(field: str):
    low, high = RANGES[field]
    beyond = [high + 1e-3] if field == "tilt" else [low - 1e-3, high + 1e-3]
    for value in beyond:
        with pytest.raises(LimitExceeded, match=f"{field} = .*Nothing has moved") as caught:
            check(**{field: value})
        assert (caught.value.field, caught.value.value) == (field, pytest.approx(value))


@pytest.mark.parametrize("field", ["x", "y", "z", "speed", "acceleration"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_refused(field: str, value: float):
    with pytest.raises(LimitExceeded) as caught:
        check(**{field: value})
    assert caught.value.field == field


@pytest.mark.parametrize("quaternion", [(math.nan,) * 4, (0.0,) * 4])
def test_an_orientation_that_is_none_is_refused_like_a_tilt(quaternion: tuple[float, float, float, float]):
    with pytest.raises(DeviceError, match="tilt"):
        LIMITS.check("robot", Pose(400.0, 0.0, 200.0, *quaternion), speed_mm_s=100.0, acc_mm_s2=500.0)


@settings(deadline=None)
@given(st.floats(-180.0, 180.0))
def test_a_tilt_at_the_limit_stays_inside_after_a_trip_over_the_wire(heading: float):
    pose = brush_pose(400.0, 0.0, 200.0, heading_deg=heading, tilt_deg=15.0)
    LIMITS.check("robot", from_wire(to_wire(pose)), speed_mm_s=100.0, acc_mm_s2=500.0)


def test_a_tool_that_points_up_is_far_outside_the_tilt_cone():
    up = from_wire([0.4, 0.0, 0.2, 0.0, 0.0, 0.0])
    with pytest.raises(LimitExceeded) as caught:
        LIMITS.check("robot", up, speed_mm_s=100.0, acc_mm_s2=500.0)
    assert caught.value.value == pytest.approx(180.0)
