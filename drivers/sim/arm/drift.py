"""Ways whose parameter is time: a velocity that changes at a given acceleration into another, and then stays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.samples import Pose
from drivers.sim.arm.kinematics import Joints, Matrix
from drivers.sim.arm.paths import InJoints, InSpace

Vector = tuple[float, ...]
FOREVER_S = 3600.0
STRETCH_MM = 5.0


@dataclass(frozen=True)
class Drift(InSpace):
    """Of the tip: [mm/s x3, rad/s x3] in the base frame, from `v0` to `v1` at `acc` mm/s2."""

    start: Pose
    v0: Vector
    v1: Vector
    acc: float
    length: float = FOREVER_S
    """In s."""
    angular: bool = False

    @property
    def turn_s(self) -> float:
        """When `v1` is reached. Turns count as if a rad were a metre."""
        change = np.subtract(self.v1, self.v0)
        return max(float(np.linalg.norm(change[:3])), 1e3 * float(np.linalg.norm(change[3:]))) / self.acc

    @property
    def stretches(self) -> int:
        """One for every few mm that it can go."""
        fastest = max(math.hypot(*v[:3]) for v in (self.v0, self.v1))
        return min(max(math.ceil(fastest * self.length / STRETCH_MM), 1), 1000)

    def velocity(self, t: float) -> Vector:
        """At time `t`."""
        return _velocity(self.v0, self.v1, self.turn_s, t)

    def pose(self, done: float) -> Pose:
        """Where the tip is."""
        way = _way(self.v0, self.v1, self.turn_s, done)
        x, y, z = (p + w for p, w in zip(self.start.position_mm, way[:3], strict=True))
        turn = Rotation.from_rotvec(way[3:]) * Rotation.from_quat(self.start.quaternion)
        qx, qy, qz, qw = (float(v) for v in turn.as_quat())
        return Pose(float(x), float(y), float(z), qx, qy, qz, qw)


@dataclass(frozen=True)
class JointDrift(InJoints):
    """Of the joints: rad/s, from `v0` to `v1` at `acc` rad/s2."""

    start: Joints
    v0: Vector
    v1: Vector
    acc: float
    tool: Matrix
    length: float = FOREVER_S
    angular: bool = True

    @property
    def turn_s(self) -> float:
        """When `v1` is reached."""
        return float(np.abs(np.subtract(self.v1, self.v0)).max()) / self.acc

    @property
    def stretches(self) -> int:
        """One for every hundredth of a radian."""
        fastest = max(abs(v) for v in (*self.v0, *self.v1))
        return min(max(math.ceil(100.0 * fastest * self.length), 1), 1000)

    def velocity(self, t: float) -> Vector:
        """At time `t`."""
        return _velocity(self.v0, self.v1, self.turn_s, t)

    def joints(self, done: float) -> Joints:
        """The joints after so many seconds."""
        q = [a + b for a, b in zip(self.start, _way(self.v0, self.v1, self.turn_s, done), strict=True)]
        return (q[0], q[1], q[2], q[3], q[4], q[5])


def _velocity(v0: Vector, v1: Vector, turn_s: float, t: float) -> Vector:
    share = min(max(t, 0.0) / turn_s, 1.0) if turn_s > 0.0 else 1.0
    return tuple(a + share * (b - a) for a, b in zip(v0, v1, strict=True))


def _way(v0: Vector, v1: Vector, turn_s: float, t: float) -> list[float]:
    """The integral of the velocity."""
    turning, t = min(max(t, 0.0), turn_s), max(t, 0.0)
    bend = 0.5 * turning * turning / turn_s if turn_s > 0.0 else 0.0
    return [a * turning + (b - a) * bend + b * (t - turning) for a, b in zip(v0, v1, strict=True)]
