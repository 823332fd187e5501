"""One rotation in plain floats against scipy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brushloop.drivers import geometry as rotation
from brushloop.drivers.geometry import Quaternion

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
    assert rotation.angle_rad(q) == pytest.approx(theirs.magnitude(), **EXACT)
    matrix = theirs.as_matrix()
    assert rotation.of_matrix(matrix.tolist()) == pytest.approx(Rotation.from_matrix(matrix).as_quat(), **EXACT)


@given(turns, turns, turns)
@example(0.0, 0.0, 0.0)
@example(3e-4, 0.0, 4e-4)
@example(math.pi, 0.0, 0.0)
def test_vectors_and_angles_make_the_rotations_that_scipy_makes(x: float, y: float, z: float) -> None:
    assert rotation.of_vector((x, y, z)) == pytest.approx(Rotation.from_rotvec([x, y, z]).as_quat(), **EXACT)
    assert rotation.of_angles(x, y, z) == pytest.approx(Rotation.from_euler("ZYX", [z, y, x]).as_quat(), **EXACT)


@given(quaternions)
def test_angles_are_those_of_scipy(q: Quaternion) -> None:
    rx, ry, rz = rotation.angles(q)
    back = rotation.of_angles(rx, ry, rz)
    assert rotation.angle_rad(rotation.product(rotation.inverse(q), back)) < 1e-7
    if abs(ry) < 1.57:
        assert (rz, ry, rx) == pytest.approx(Rotation.from_quat(q).as_euler("ZYX"), abs=1e-10)


@pytest.mark.parametrize("ry", [math.pi / 2.0, -math.pi / 2.0])
def test_where_the_angles_are_not_determined_the_first_is_0(ry: float) -> None:
    q = rotation.of_angles(0.4, ry, 0.3)
    rx, same, rz = rotation.angles(q)
    assert (rx, same) == (0.0, pytest.approx(ry, abs=1e-7))
    assert rotation.angle_rad(rotation.product(rotation.inverse(q), rotation.of_angles(rx, same, rz))) < 1e-7


def test_a_quaternion_of_length_0_is_refused() -> None:
    with pytest.raises(ValueError, match="length 0"):
        rotation.unit((0.0, 0.0, 0.0, 0.0))
