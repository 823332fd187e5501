"""Poses of the brush from the quantities of the experiment: place, height, tilt and heading."""

from __future__ import annotations

import math

import numpy as np

from brushloop.drivers import rotation
from brushloop.drivers.samples import Pose

DOWN = rotation.of_vector((math.pi, 0.0, 0.0))
"""The tool pointing down."""


def brush_pose(x_mm: float, y_mm: float, z_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """Tip at (x, y, z), the tool pointing down, its ferrule leaning by `tilt_deg` toward `heading_deg`.

    Heading is counter-clockwise from the base frame's +x seen from above; the wrist turns with it, so that at
    tilt 0 the tool's x axis points along the heading.
    """
    phi = math.radians(heading_deg)
    tilt = math.radians(tilt_deg)
    leaning = rotation.of_vector((-math.sin(phi) * tilt, math.cos(phi) * tilt, 0.0))  # about z cross the heading
    turned = rotation.product(leaning, rotation.of_vector((0.0, 0.0, phi)))
    return Pose(x_mm, y_mm, z_mm, *rotation.product(turned, DOWN))


def lean(pose: Pose) -> tuple[float, float]:
    """(tilt_deg, heading_deg) of a pose: the inverse of `brush_pose`. Below 0.05 deg the wrist gives the heading."""
    x_axis, _, (x, y, z) = rotation.columns(rotation.unit(pose.quaternion))
    tilt_deg = math.degrees(math.atan2(math.hypot(x, y), -z))
    direction = (-x, -y) if tilt_deg >= 0.05 else x_axis
    return tilt_deg, math.degrees(math.atan2(direction[1], direction[0]))


def to_wire(pose: Pose) -> list[float]:
    """[x, y, z m, rx, ry, rz rad] in ARCS' order: R = Rz(rz) Ry(ry) Rx(rx)."""
    turn = rotation.angles(rotation.unit(pose.quaternion))
    return [pose.x_mm / 1e3, pose.y_mm / 1e3, pose.z_mm / 1e3, *turn]


def from_wire(values: list[float]) -> Pose:
    """The inverse of `to_wire`. Raises ValueError unless given six finite numbers."""
    if len(values) != 6 or not all(math.isfinite(v) for v in values):
        raise ValueError(f"a pose is six finite numbers, got {values!r}")
    x, y, z, rx, ry, rz = values
    return Pose(x * 1e3, y * 1e3, z * 1e3, *rotation.of_angles(rx, ry, rz))


def distance(a: Pose, b: Pose) -> tuple[float, float]:
    """(translation in mm, rotation in deg) from a to b."""
    translation_mm = math.dist(a.position_mm, b.position_mm)
    return translation_mm, math.degrees(rotation.angle_rad(_turn(a, b)))


def interpolate(a: Pose, b: Pose, s: float) -> Pose:
    """The pose a fraction `s` of the way from a to b: straight line, shortest rotation."""
    rx, ry, rz = rotation.vector(_turn(a, b))
    turned = rotation.product(rotation.unit(a.quaternion), rotation.of_vector((s * rx, s * ry, s * rz)))
    x, y, z = (p + s * (q - p) for p, q in zip(a.position_mm, b.position_mm, strict=True))
    return Pose(x, y, z, *turned)


def from_line(a: Pose, b: Pose, pose: Pose) -> tuple[float, float]:
    """(mm, deg) from the nearest place of the straight line from a to b to `pose`."""
    way, gone = np.subtract(b.position_mm, a.position_mm), np.subtract(pose.position_mm, a.position_mm)
    share = float(way @ gone) / max(float(way @ way), 1e-12)
    return distance(interpolate(a, b, min(max(share, 0.0), 1.0)), pose)


def _turn(a: Pose, b: Pose) -> rotation.Quaternion:
    """The rotation from a to b, in a's own axes."""
    return rotation.product(rotation.inverse(rotation.unit(a.quaternion)), rotation.unit(b.quaternion))


def steepest_deg(a: Pose, b: Pose) -> float:
    """The largest tilt on the way from a to b, in deg: it may exceed the tilt of both ends."""
    start = rotation.unit(a.quaternion)
    turn = np.array(rotation.vector(rotation.product(rotation.unit(b.quaternion), rotation.inverse(start))))
    ferrule = -np.array(rotation.columns(start)[2])
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 1e-9 else np.array([0.0, 0.0, 1.0])
    # How upright the ferrule is after a turn by t: along + even cos t + odd sin t.
    along = float(axis @ ferrule) * float(axis[2])
    even, odd = float(ferrule[2]) - along, float(np.cross(axis, ferrule)[2])
    lowest = (math.atan2(odd, even) + math.pi) % math.tau
    upright = min(along + even * math.cos(t) + odd * math.sin(t) for t in (0.0, angle, min(lowest, angle)))
    return math.degrees(math.acos(max(-1.0, min(1.0, upright))))
