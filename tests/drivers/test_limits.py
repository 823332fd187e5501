import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import DeviceError, LimitExceeded
from brushloop.drivers.geometry import brush_pose, from_wire, interpolate, lean, steepest_deg, to_wire
from brushloop.drivers.limits import Limits

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


def leaning(tilt_deg: float, toward_deg: float, wrist_deg: float, z_mm: float = 200.0) -> Pose:
    """A pose that another client may have left: the wrist is turned whichever way the tool leans."""
    upright = Rotation.from_euler("x", 180.0, degrees=True)
    turned = Rotation.from_euler("zyz", [wrist_deg, tilt_deg, toward_deg], degrees=True) * upright
    qx, qy, qz, qw = (float(v) for v in turned.as_quat())
    return Pose(400.0, 0.0, z_mm, qx, qy, qz, qw)


def test_a_way_between_two_poses_within_the_cone_may_leave_it() -> None:
    start, target = leaning(14.0, 0.0, 0.0), leaning(14.0, 90.0, 90.0)
    LIMITS.check("robot", start, speed_mm_s=100.0, acc_mm_s2=500.0)
    LIMITS.check("robot", target, speed_mm_s=100.0, acc_mm_s2=500.0)
    with pytest.raises(LimitExceeded, match=r"tilt on the way = 19\.702 deg is outside \[0.000, 15.000\] deg"):
        LIMITS.check_way("robot", start, target)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(0.0, 40.0), *[st.floats(-180.0, 180.0)] * 2] * 2))
def test_the_steepest_tilt_on_a_way_is_that_of_its_steepest_pose(angles: tuple[float, ...]) -> None:
    start, target = leaning(*angles[:3]), leaning(*angles[3:])
    sampled = max(lean(interpolate(start, target, k / 100))[0] for k in range(101))
    assert sampled - 1e-4 <= steepest_deg(start, target) <= sampled + 0.05


def test_an_arm_that_rests_a_little_beyond_a_limit_may_leave_it() -> None:
    for start in (brush_pose(400.0, 0.0, 94.95), brush_pose(640.05, 0.0, 200.0), leaning(15.1, 30.0, 0.0)):
        LIMITS.check_start("robot", start)
        LIMITS.check_way("robot", start, brush_pose(400.0, 0.0, 200.0))
