"""Rotations as unit quaternions (x, y, z, w), and poses of the brush from place, height, tilt and heading.

In plain floats, for single poses at the pace of a control loop: scipy's `Rotation` gives the same values
(tests/drivers/test_geometry.py), but spends 30 to 300 us on a call, most of it on finding out what it was given. Use it
for arrays of rotations.

Formulas: J. Diebel, Representing Attitude (2006).
"""

import math
from collections.abc import Sequence

import numpy as np

from brushloop.drivers.devices import Pose

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


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
    share = math.sin(angle / 2.0) / angle if angle > 0.0 else 0.5
    return share * x, share * y, share * z, math.cos(angle / 2.0)


def vector(q: Quaternion) -> Vector:
    """The inverse of `of_vector`, of a unit quaternion; its length is at most pi."""
    x, y, z, w = q if q[3] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.sqrt(x * x + y * y + z * z)
    share = 2.0 * math.atan2(sine, w) / sine if sine > 0.0 else 2.0
    return share * x, share * y, share * z


def of_angles(rx: float, ry: float, rz: float) -> Quaternion:
    """Rz(rz) Ry(ry) Rx(rx), angles in rad."""
    about_x, about_y, about_z = of_vector((rx, 0.0, 0.0)), of_vector((0.0, ry, 0.0)), of_vector((0.0, 0.0, rz))
    return product(product(about_z, about_y), about_x)


def angles(q: Quaternion) -> Vector:
    """(rx, ry, rz) in rad, the inverse of `of_angles`; rx is 0 where ry is a right angle and leaves it undetermined."""
    (xx, xy, xz), (yx, yy, yz), (_, _, zz) = columns(q)
    level = math.hypot(xx, xy)
    ry = math.atan2(-xz, level)
    if level < 1e-7:
        return 0.0, ry, math.atan2(-yx, yy)
    return math.atan2(yz, zz), ry, math.atan2(xy, xx)


DOWN = of_vector((math.pi, 0.0, 0.0))
"""The tool pointing down."""


def brush_pose(x_mm: float, y_mm: float, z_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """Tip at (x, y, z), the tool pointing down, its ferrule leaning by `tilt_deg` toward `heading_deg`.

    Heading is counter-clockwise from the base frame's +x seen from above; the wrist turns with it, so that at
    tilt 0 the tool's x axis points along the heading.
    """
    phi = math.radians(heading_deg)
    tilt = math.radians(tilt_deg)
    leaning = of_vector((-math.sin(phi) * tilt, math.cos(phi) * tilt, 0.0))  # about z cross the heading
    leant = product(leaning, of_vector((0.0, 0.0, phi)))
    return Pose(x_mm, y_mm, z_mm, *product(leant, DOWN))


def lean(pose: Pose) -> tuple[float, float]:
    """(tilt_deg, heading_deg) of a pose: the inverse of `brush_pose`. Below 0.05 deg the wrist gives the heading."""
    x_axis, _, (x, y, z) = columns(unit(pose.quaternion))
    tilt_deg = math.degrees(math.atan2(math.hypot(x, y), -z))
    direction = (-x, -y) if tilt_deg >= 0.05 else x_axis
    return tilt_deg, math.degrees(math.atan2(direction[1], direction[0]))


def to_wire(pose: Pose) -> list[float]:
    """[x, y, z m, rx, ry, rz rad] in ARCS' order: R = Rz(rz) Ry(ry) Rx(rx)."""
    turn = angles(unit(pose.quaternion))
    return [pose.x_mm / 1e3, pose.y_mm / 1e3, pose.z_mm / 1e3, *turn]


def from_wire(values: list[float]) -> Pose:
    """The inverse of `to_wire`, of six numbers that `arcs.wire.numbers` has checked, or a configuration."""
    x, y, z, rx, ry, rz = values
    return Pose(x * 1e3, y * 1e3, z * 1e3, *of_angles(rx, ry, rz))


def distance(a: Pose, b: Pose) -> tuple[float, float]:
    """(translation in mm, rotation in deg) from a to b."""
    x, y, z, w = _turn(a, b)
    angle = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))
    return math.dist(a.position_mm, b.position_mm), math.degrees(angle)


def interpolate(a: Pose, b: Pose, s: float) -> Pose:
    """The pose a fraction `s` of the way from a to b: straight line, shortest rotation."""
    rx, ry, rz = vector(_turn(a, b))
    there = product(unit(a.quaternion), of_vector((s * rx, s * ry, s * rz)))
    x, y, z = (p + s * (q - p) for p, q in zip(a.position_mm, b.position_mm, strict=True))
    return Pose(x, y, z, *there)


def from_line(a: Pose, b: Pose, pose: Pose) -> tuple[float, float]:
    """(mm, deg) from the nearest place of the straight line from a to b to `pose`."""
    line, along = np.subtract(b.position_mm, a.position_mm), np.subtract(pose.position_mm, a.position_mm)
    share = float(line @ along) / max(float(line @ line), 1e-12)
    return distance(interpolate(a, b, min(max(share, 0.0), 1.0)), pose)


def _turn(a: Pose, b: Pose) -> Quaternion:
    """The rotation from a to b, in a's own axes."""
    return product(inverse(unit(a.quaternion)), unit(b.quaternion))


def steepest_deg(a: Pose, b: Pose) -> float:
    """The largest tilt on the way from a to b, in deg: it may exceed the tilt of both ends."""
    start = unit(a.quaternion)
    turn = np.array(vector(product(unit(b.quaternion), inverse(start))))
    ferrule = -np.array(columns(start)[2])
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 1e-9 else np.array([0.0, 0.0, 1.0])
    # How upright the ferrule is after a turn by t: along + even cos t + odd sin t.
    along = float(axis @ ferrule) * float(axis[2])
    even, odd = float(ferrule[2]) - along, float(np.cross(axis, ferrule)[2])
    lowest = (math.atan2(odd, even) + math.pi) % math.tau
    upright = min(along + even * math.cos(t) + odd * math.sin(t) for t in (0.0, angle, min(lowest, angle)))
    return math.degrees(math.acos(max(-1.0, min(1.0, upright))))
