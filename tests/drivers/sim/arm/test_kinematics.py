"""The nominal i5 against the facts that are known of it, and back again."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.geometry import brush_pose, distance, from_wire, to_wire
from brushloop.drivers.sim.arm.kinematics import HOME, LIMITS_DEG, forward, inverse, matrix_of, pose_of

TOOL = np.eye(4)
TOOL[2, 3] = 0.18
joints = st.tuples(*(st.floats(-2.8, 2.8) for _ in range(6)))


def test_the_home_position_is_where_the_maker_says():
    off_mm, off_deg = distance(pose_of(forward(HOME)), from_wire([0.5489, -0.1215, 0.2632, math.pi, 0.0, math.pi / 2]))
    assert off_mm < 0.1
    assert off_deg < 1e-4


def test_the_zero_position_is_where_the_maker_says():
    assert to_wire(pose_of(forward([0.0] * 6)))[:3] == pytest.approx([0.0, -0.2155, 1.0085], abs=1e-6)


@pytest.mark.parametrize("q", [[], [0.0] * 5, [0.0] * 7, [math.nan, *[0.0] * 5]])
def test_joints_that_are_none_are_refused(q: list[float]):
    with pytest.raises(ValueError, match="six finite"):
        forward(q)


@settings(deadline=None, max_examples=60)
@given(joints, st.tuples(*(st.floats(-0.1, 0.1) for _ in range(6))))
def test_what_the_inverse_finds_is_right(q: tuple[float, ...], off: tuple[float, ...]):
    found = inverse(forward(q), [a + b for a, b in zip(q, off, strict=True)])
    if found is not None:  # near a singular position it may give up
        assert np.allclose(forward(found), forward(q), atol=1e-6)
        assert all(abs(v) <= math.radians(limit) for v, limit in zip(found, LIMITS_DEG, strict=True))


def test_near_a_solution_the_inverse_finds_that_one():
    found = inverse(forward(HOME), [v + 0.05 for v in HOME])
    assert found == pytest.approx(HOME, abs=1e-5)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
def test_every_place_over_the_sheet_is_within_reach(tilt_deg: float):
    places = itertools.product((200.0, 420.0, 600.0), (-260.0, 0.0, 260.0), (95.0, 240.0), (-170.0, 0.0, 90.0))
    for x, y, z, heading in places:
        flange = matrix_of(brush_pose(x, y, z, heading_deg=heading, tilt_deg=tilt_deg)) @ np.linalg.inv(TOOL)
        found = inverse(flange, HOME)
        assert found is not None, (x, y, z, heading)
        assert np.allclose(forward(found), flange, atol=1e-6)


@pytest.mark.parametrize("place", [(900.0, 0.0, 250.0), (0.0, 0.0, 1500.0), (20.0, 0.0, 300.0)])
def test_a_place_out_of_reach_has_no_joints(place: tuple[float, float, float]):
    assert inverse(matrix_of(brush_pose(*place)), HOME) is None


def test_a_pose_survives_the_matrix():
    pose = brush_pose(300.0, -200.0, 240.0, heading_deg=40.0, tilt_deg=10.0)
    assert distance(pose, pose_of(matrix_of(pose))) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-5))
