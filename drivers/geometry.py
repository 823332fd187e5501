"""Poses of the brush from the quantities of the experiment: place, height, tilt and heading."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.samples import Pose


def brush_pose(x_mm: float, y_mm: float, z_mm: float, *, heading_deg: float = 0.0, tilt_deg: float = 0.0) -> Pose:
    """Tip at (x, y, z), the tool pointing down, its ferrule leaning by `tilt_deg` toward `heading_deg`.

    Heading is counter-clockwise from the base frame's +x seen from above; the wrist turns with it, so that at
    tilt 0 the tool's x axis points along the heading.
    """
    phi = math.radians(heading_deg)
    lean_axis = np.array([-math.sin(phi), math.cos(phi), 0.0])  # z cross the heading direction
    rotation = (
        Rotation.from_rotvec(math.radians(tilt_deg) * lean_axis)
        * Rotation.from_rotvec([0.0, 0.0, phi])
        * Rotation.from_rotvec([math.pi, 0.0, 0.0])
    )
    qx, qy, qz, qw = (float(v) for v in rotation.as_quat())
    return Pose(x_mm, y_mm, z_mm, qx, qy, qz, qw)


def lean(pose: Pose) -> tuple[float, float]:
    """(tilt_deg, heading_deg) of a pose: the inverse of `brush_pose`. Below 0.05 deg the wrist gives the heading."""
    matrix = Rotation.from_quat(pose.quaternion).as_matrix()
    ferrule = -matrix[:, 2]
    tilt_deg = math.degrees(math.atan2(math.hypot(ferrule[0], ferrule[1]), ferrule[2]))
    direction = ferrule if tilt_deg >= 0.05 else matrix[:, 0]
    return tilt_deg, math.degrees(math.atan2(direction[1], direction[0]))


def to_wire(pose: Pose) -> list[float]:
    """[x, y, z m, rx, ry, rz rad] in ARCS' order: R = Rz(rz) Ry(ry) Rx(rx)."""
    rz, ry, rx = Rotation.from_quat(pose.quaternion).as_euler("ZYX")
    return [pose.x_mm / 1e3, pose.y_mm / 1e3, pose.z_mm / 1e3, float(rx), float(ry), float(rz)]


def from_wire(values: list[float]) -> Pose:
    """The inverse of `to_wire`. Raises ValueError unless given six finite numbers."""
    if len(values) != 6 or not all(math.isfinite(v) for v in values):
        raise ValueError(f"a pose is six finite numbers, got {values!r}")
    x, y, z, rx, ry, rz = values
    qx, qy, qz, qw = (float(v) for v in Rotation.from_euler("ZYX", [rz, ry, rx]).as_quat())
    return Pose(x * 1e3, y * 1e3, z * 1e3, qx, qy, qz, qw)


def distance(a: Pose, b: Pose) -> tuple[float, float]:
    """(translation in mm, rotation in deg) from a to b."""
    translation_mm = math.dist(a.position_mm, b.position_mm)
    turn = Rotation.from_quat(a.quaternion).inv() * Rotation.from_quat(b.quaternion)
    return translation_mm, math.degrees(float(turn.magnitude()))


def interpolate(a: Pose, b: Pose, s: float) -> Pose:
    """The pose a fraction `s` of the way from a to b: straight line, shortest rotation."""
    start = Rotation.from_quat(a.quaternion)
    turn = (start.inv() * Rotation.from_quat(b.quaternion)).as_rotvec()
    qx, qy, qz, qw = (float(v) for v in (start * Rotation.from_rotvec(s * turn)).as_quat())
    x, y, z = (p + s * (q - p) for p, q in zip(a.position_mm, b.position_mm, strict=True))
    return Pose(x, y, z, qx, qy, qz, qw)


def steepest_deg(a: Pose, b: Pose) -> float:
    """The largest tilt on the way from a to b, in deg: it may exceed the tilt of both ends."""
    start = Rotation.from_quat(a.quaternion)
    turn = (Rotation.from_quat(b.quaternion) * start.inv()).as_rotvec()
    ferrule = -start.as_matrix()[:, 2]
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 1e-9 else np.array([0.0, 0.0, 1.0])
    # How upright the ferrule is after a turn by t: along + even cos t + odd sin t.
    along = float(axis @ ferrule) * float(axis[2])
    even, odd = float(ferrule[2]) - along, float(np.cross(axis, ferrule)[2])
    lowest = (math.atan2(odd, even) + math.pi) % math.tau
    upright = min(along + even * math.cos(t) + odd * math.sin(t) for t in (0.0, angle, min(lowest, angle)))
    return math.degrees(math.acos(max(-1.0, min(1.0, upright))))
