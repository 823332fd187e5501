"""One rotation against scipy, poses of the brush from place, height, tilt and heading, and the limits of poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brushloop.drivers import geometry as rotation
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import LimitExceeded
from brushloop.drivers.geometry import (
    Quaternion,
    brush_pose,
    distance,
    from_wire,
    interpolate,
    lean,
    steepest_deg,
    to_wire,
)
from brushloop.drivers.limits import Limits

parts = st.floats(-1.0, 1.0)
quaternions = st.tuples(parts, parts, parts, parts).filter(lambda q: math.hypot(*q) > 0.1).map(rotation.unit)
turns = st.floats(-math.pi, math.pi)
EXACT = {"rel": 0.0, "abs": 1e-14}


@given(quaternions, quaternions)
@example((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
def test_products_matrices_and_vectors_are_those_of_scipy(p: Quaternion, q: Quaternion) -> None:
    theirs = Rotation.from_quat(q)
    assert rotation.product(p, q) == pytest.approx((Rotation.from_quat(p) * theirs).as_quat(), **EXACT)
    assert rotation.inverse(q) == pytest.approx(theirs.inv().as_quat(), **EXACT)
    assert np.transpose(rotation.columns(q)) == pytest.approx(theirs.as_matrix(), **EXACT)
    assert rotation.turned(q, (1.0, -2.0, 3.0)) == pytest.approx(theirs.apply([1.0, -2.0, 3.0]), **EXACT)
    assert rotation.vector(q) == pytest.approx(theirs.as_rotvec(), **EXACT)
    matrix = theirs.as_matrix()
    assert rotation.of_matrix(matrix.tolist()) == pytest.approx(Rotation.from_matrix(matrix).as_quat(), **EXACT)


@given(turns, turns, turns)
@example(0.0, 0.0, 0.0)
@example(3e-4, 0.0, 4e-4)
@example(math.pi, 0.0, 0.0)
def test_vectors_and_angles_make_the_rotations_that_scipy_makes(x: float, y: float, z: float) -> None:
    assert rotation.of_vector((x, y, z)) == pytest.approx(Rotation.from_rotvec([x, y, z]).as_quat(), **EXACT)
    assert rotation.of_angles(x, y, z) == pytest.approx(Rotation.from_euler("ZYX", [z, y, x]).as_quat(), **EXACT)


lengths = st.floats(-900.0, 900.0)
headings = st.floats(-180.0, 180.0)
tilts = st.floats(0.0, 30.0)
poses = st.builds(
    lambda x, y, z, heading, tilt: brush_pose(x, y, z, heading_deg=heading, tilt_deg=tilt),
    *(lengths, lengths, lengths, headings, tilts),
)


@given(lengths, lengths, lengths, turns, turns, turns)
@example(1.0, 2.0, 3.0, 0.5, math.pi / 2.0, 1.5)
def test_a_wire_pose_survives_us(x: float, y: float, z: float, rx: float, ry: float, rz: float):
    wire = [x / 1e3, y / 1e3, z / 1e3, rx, ry, rz]
    back = to_wire(from_wire(wire))
    assert back[:3] == pytest.approx(wire[:3])
    assert abs(back[4]) <= math.pi / 2.0
    before, after = (Rotation.from_euler("ZYX", pose[:2:-1]) for pose in (wire, back))
    assert (before.inv() * after).magnitude() < (1e-10 if abs(back[4]) < 1.57 else 1e-6)


@given(tilts, headings)
def test_lean_is_the_inverse_of_brush_pose(tilt: float, heading: float):
    got_tilt, got_heading = lean(brush_pose(1.0, 2.0, 3.0, heading_deg=heading, tilt_deg=tilt))
    assert got_tilt == pytest.approx(tilt, abs=1e-5)
    assert math.remainder(got_heading - heading, 360.0) == pytest.approx(0.0, abs=0.01)


def test_the_ferrule_leans_toward_the_heading():
    ferrule = rotation.turned(brush_pose(0.0, 0.0, 0.0, heading_deg=90.0, tilt_deg=10.0).quaternion, (0.0, 0.0, -1.0))
    ten = math.radians(10.0)
    assert ferrule == pytest.approx([0.0, math.sin(ten), math.cos(ten)])


@given(poses, poses, st.floats(0.0, 1.0))
def test_on_the_way_both_distances_are_shared_out(a: Pose, b: Pose, s: float):
    total_mm, total_deg = distance(a, b)
    done_mm, done_deg = distance(a, interpolate(a, b, s))
    assert done_mm == pytest.approx(s * total_mm, abs=1e-6)
    assert done_deg == pytest.approx(s * total_deg, abs=1e-4)


# ---------------------------------------------------------------- the limits

LIMITS = Limits(x_mm=(200.0, 640.0), y_mm=(-260.0, 260.0), z_mm=(95.0, 400.0))
RANGES = {
    "x": (200.0, 640.0),
    "y": (-260.0, 260.0),
    "z": (95.0, 400.0),
    "tilt": (0.0, 15.0),
    "speed": (0.1, 250.0),
    "acceleration": (1.0, 1000.0),
}


def check(**change: float) -> None:
    at: dict[str, float] = {field: sum(ends) / 2.0 for field, ends in RANGES.items()} | change
    pose = brush_pose(at["x"], at["y"], at["z"], heading_deg=70.0, tilt_deg=at["tilt"])
    LIMITS.check("robot", pose, speed_mm_s=at["speed"], acc_mm_s2=at["acceleration"])


@pytest.mark.parametrize("field", RANGES)
def test_both_ends_of_a_range_are_inside_and_a_step_beyond_and_what_is_no_number_are_refused_by_name(field: str):
    low, high = RANGES[field]
    for bound in (low, high):
        check(**{field: bound})
    tilted = field == "tilt"
    for value in [high + 1e-3] if tilted else [low - 1e-3, high + 1e-3, math.nan, math.inf, -math.inf]:
        with pytest.raises(LimitExceeded, match=f"{field} = {value:.3f} .*Nothing has moved"):
            check(**{field: value})


def test_an_orientation_that_is_none_is_refused_like_a_tilt():
    for quaternion in ((math.nan,) * 4, (0.0,) * 4):
        with pytest.raises(LimitExceeded, match="tilt"):
            LIMITS.check("robot", Pose(400.0, 0.0, 200.0, *quaternion), speed_mm_s=100.0, acc_mm_s2=500.0)


@given(st.floats(-180.0, 180.0))
def test_a_tilt_at_the_limit_stays_inside_after_a_trip_over_the_wire(heading: float):
    pose = brush_pose(400.0, 0.0, 200.0, heading_deg=heading, tilt_deg=15.0)
    LIMITS.check("robot", from_wire(to_wire(pose)), speed_mm_s=100.0, acc_mm_s2=500.0)


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


@given(st.tuples(*[st.floats(0.0, 40.0), *[st.floats(-180.0, 180.0)] * 2] * 2))
def test_the_steepest_tilt_on_a_way_is_that_of_its_steepest_pose(angles: tuple[float, ...]) -> None:
    start, target = leaning(*angles[:3]), leaning(*angles[3:])
    sampled = max(lean(interpolate(start, target, k / 100))[0] for k in range(101))
    assert sampled - 1e-4 <= steepest_deg(start, target) <= sampled + 0.05


def test_an_arm_that_rests_a_little_beyond_a_limit_may_leave_it() -> None:
    for start in (brush_pose(400.0, 0.0, 94.95), brush_pose(640.05, 0.0, 200.0), leaning(15.1, 30.0, 0.0)):
        LIMITS.check_start("robot", start)
        LIMITS.check_way("robot", start, brush_pose(400.0, 0.0, 200.0))


def test_from_below_the_floor_only_the_tool_axis_leads_up() -> None:
    deep, out_mm = brush_pose(400.0, 0.0, 80.0, tilt_deg=10.0), 120.0 * math.tan(math.radians(10.0))
    LIMITS.check_way("robot", deep, brush_pose(400.0 + out_mm, 0.0, 200.0, tilt_deg=10.0))
    for x_mm, y_mm, tilt_deg in [(400.0, 0.0, 10.0), (400.0 + out_mm, 0.0, 0.0), (550.0, 100.0, 10.0)]:
        with pytest.raises(LimitExceeded, match=r"the arm stands where z = 80.000 mm is outside \[95"):
            LIMITS.check_way("robot", deep, brush_pose(x_mm, y_mm, 200.0, tilt_deg=tilt_deg))
