"""Rotations as unit quaternions (x, y, z, w) in plain floats, for single poses at the pace of a control loop.

scipy's `Rotation` gives the same values (tests/drivers/test_rotation.py), but spends 30 to 300 us on a call, most of it
on finding out what it was given. Use it for arrays of rotations; here are the few operations on one.

Formulas as in scipy: J. Diebel, Representing Attitude (2006); Euler angles after E. Bernardes and S. Viollet,
PLoS ONE 17 (2022) e0276302.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]
SMALL_RAD = 1e-3
"""Below this angle, sin(angle / 2) / angle is its Taylor series."""


def unit(q: Quaternion) -> Quaternion:
    """`q` scaled to length 1. Raises ValueError for (0, 0, 0, 0), which is no rotation."""
    x, y, z, w = q
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if length == 0.0:
        raise ValueError("a quaternion of length 0 is no rotation")
    return x / length, y / length, z / length, w / length


def inverse(q: Quaternion) -> Quaternion:
    """The opposite rotation, of a unit quaternion."""
    return -q[0], -q[1], -q[2], q[3]


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """First `q`, then `p`, both about fixed axes; of length 1."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return unit(
        (
            pw * qx + qw * px + py * qz - pz * qy,
            pw * qy + qw * py + pz * qx - px * qz,
            pw * qz + qw * pz + px * qy - py * qx,
            pw * qw - px * qx - py * qy - pz * qz,
        )
    )


def columns(q: Quaternion) -> tuple[Vector, Vector, Vector]:
    """The columns of the rotation matrix: where a unit quaternion turns the x, y and z axes to."""
    x, y, z, w = q
    return (
        (x * x - y * y - z * z + w * w, 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)),
        (2.0 * (x * y - z * w), -x * x + y * y - z * z + w * w, 2.0 * (y * z + x * w)),
        (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), -x * x - y * y + z * z + w * w),
    )


def turned(q: Quaternion, v: Sequence[float]) -> Vector:
    """Where a unit quaternion turns a vector to."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = columns(q)
    x, y, z = v
    return ax * x + bx * y + cx * z, ay * x + by * y + cy * z, az * x + bz * y + cz * z


def of_matrix(m: Sequence[Sequence[float]]) -> Quaternion:
    """The rotation of an orthogonal (3, 3) matrix, by the largest of its diagonal and trace."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = m
    trace = m00 + m11 + m22
    most = max(m00, m11, m22, trace)
    if most == m00:
        return unit((1.0 - trace + 2.0 * m00, m10 + m01, m20 + m02, m21 - m12))
    if most == m11:
        return unit((m10 + m01, 1.0 - trace + 2.0 * m11, m21 + m12, m02 - m20))
    if most == m22:
        return unit((m20 + m02, m21 + m12, 1.0 - trace + 2.0 * m22, m10 - m01))
    return unit((m21 - m12, m02 - m20, m10 - m01, 1.0 + trace))


def of_vector(turn_rad: Vector) -> Quaternion:
    """The rotation about `turn_rad` by its length."""
    x, y, z = turn_rad
    angle = math.sqrt(x * x + y * y + z * z)
    small = angle <= SMALL_RAD
    share = 0.5 - angle**2 / 48.0 + angle**4 / 3840.0 if small else math.sin(angle / 2.0) / angle
    return share * x, share * y, share * z, math.cos(angle / 2.0)


def vector(q: Quaternion) -> Vector:
    """The inverse of `of_vector`; its length is at most pi."""
    x, y, z, w = q if q[3] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    angle = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), w)
    small = angle <= SMALL_RAD
    share = 2.0 + angle**2 / 12.0 + 7.0 * angle**4 / 2880.0 if small else angle / math.sin(angle / 2.0)
    return share * x, share * y, share * z


def angle_rad(q: Quaternion) -> float:
    """The angle of the rotation, 0 to pi."""
    x, y, z, w = q
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def of_angles(rx: float, ry: float, rz: float) -> Quaternion:
    """Rz(rz) Ry(ry) Rx(rx), angles in rad."""
    about_x = (math.sin(rx / 2.0), 0.0, 0.0, math.cos(rx / 2.0))
    about_y = (0.0, math.sin(ry / 2.0), 0.0, math.cos(ry / 2.0))
    about_z = (0.0, 0.0, math.sin(rz / 2.0), math.cos(rz / 2.0))
    return product(product(about_z, about_y), about_x)


def angles(q: Quaternion) -> Vector:
    """(rx, ry, rz) in rad, the inverse of `of_angles`; rx is 0 where ry is a right angle and leaves it undetermined."""
    x, y, z, w = q
    a, b, c, d = w - y, x + z, y + w, z - x
    ry = 2.0 * math.atan2(math.hypot(c, d), math.hypot(a, b))
    half_sum, half_difference = math.atan2(b, a), math.atan2(d, c)
    if ry <= 1e-7:
        rx, rz = 0.0, 2.0 * half_sum
    elif math.pi - ry <= 1e-7:
        rx, rz = 0.0, 2.0 * half_difference
    else:
        rx, rz = half_sum - half_difference, half_sum + half_difference
    return _wrapped(rx), _wrapped(ry - math.pi / 2.0), _wrapped(rz)


def _wrapped(angle: float) -> float:
    if angle < -math.pi:
        return angle + math.tau
    return angle - math.tau if angle > math.pi else angle
