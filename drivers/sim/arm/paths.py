"""Paths of the loopback arm's tip: lines in space and in joints, and the corners that join two lines in space."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from brushloop.drivers.geometry import distance, interpolate
from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.arm.kinematics import Joints, Matrix, forward, matrix_of, pose_of

ROTATION_AS_LINEAR_MM = 1.0
"""Below this travel, ARCS reads speed and acceleration as rad/s and rad/s2."""
TURN_RAD = 1e-4
STRETCHES = 16
"""Number of straight pieces in which a curved path is reported to the world."""


class Path(abc.ABC):
    """A path of `length` mm, or rad where `angular`."""

    @property
    @abc.abstractmethod
    def length(self) -> float:
        """Length from end to end."""

    @property
    def angular(self) -> bool:
        """True where lengths are in rad."""
        return False

    @property
    def stretches(self) -> int:
        """Number of straight pieces that approximate it; 1 for a straight line."""
        return STRETCHES

    @abc.abstractmethod
    def pose(self, done: float) -> Pose:
        """Where the true tip is after `done`."""

    def joints(self, done: float) -> Joints | None:
        """The joints there; None where the path is not given in joints."""
        return None


@dataclass(frozen=True)
class Line(Path):
    """Straight for the tool centre point that was configured; `fix` leads from there to the true tip (None: same)."""

    start: Pose
    end: Pose
    fix: Matrix | None = None

    @cached_property
    def _measure(self) -> tuple[float, float]:
        travel_mm, turn_deg = distance(self.start, self.end)
        return travel_mm, math.radians(turn_deg)

    @property
    def angular(self) -> bool:
        """True for a turn on the spot."""
        travel_mm, turn_rad = self._measure
        return travel_mm < ROTATION_AS_LINEAR_MM and turn_rad > TURN_RAD

    @property
    def length(self) -> float:
        """Length of the line, or of the turn."""
        return self._measure[1] if self.angular else self._measure[0]

    @property
    def stretches(self) -> int:
        """1 unless the true tip circles a wrongly configured tool centre point."""
        return 1 if self.fix is None or self._measure[1] < TURN_RAD else STRETCHES

    def along(self, done: float) -> Pose:
        """The configured tool centre point after `done`; the ends are exact."""
        if done >= self.length:
            return self.end
        return self.start if done <= 0.0 else interpolate(self.start, self.end, done / self.length)

    def pose(self, done: float) -> Pose:
        """Where the true tip is."""
        return fixed(self.along(done), self.fix)


@dataclass(frozen=True)
class Corner(Path):
    """The parabola that leaves `a` at `cut` before its end and meets `b` at `cut` after its start, turns included."""

    a: Line
    b: Line
    cut: float

    @property
    def length(self) -> float:
        """Length that the corner replaces; the curve itself is shorter."""
        return 2.0 * self.cut

    @cached_property
    def bend(self) -> float:
        """Length of the difference of the two unit directions: 0 for straight on, 2 for a reversal."""
        ways = [np.subtract(w.end.position_mm, w.start.position_mm) / w.length for w in (self.a, self.b)]
        return float(np.linalg.norm(ways[1] - ways[0]))

    def pose(self, done: float) -> Pose:
        """Where the true tip is after `done`, by de Casteljau's algorithm."""
        u = done / self.length
        start, end = self.a.along(self.a.length - self.cut), self.b.along(self.cut)
        there = interpolate(interpolate(start, self.a.end, u), interpolate(self.b.start, end, u), u)
        return fixed(there, self.a.fix)


@dataclass(frozen=True)
class JointLine(Path):
    """Straight in joints; its length is the angle of the joint that turns farthest."""

    start: Joints
    end: Joints
    tool: Matrix

    @property
    def angular(self) -> bool:
        """Lengths are in rad."""
        return True

    @property
    def length(self) -> float:
        """The largest angle."""
        return max(abs(a - b) for a, b in zip(self.start, self.end, strict=True))

    def joints(self, done: float) -> Joints:
        """The joints after `done`."""
        if done >= self.length:
            return self.end
        share = max(done, 0.0) / self.length
        q = [a + share * (b - a) for a, b in zip(self.start, self.end, strict=True)]
        return (q[0], q[1], q[2], q[3], q[4], q[5])

    def pose(self, done: float) -> Pose:
        """Where the tip is."""
        return pose_of(forward(self.joints(done)) @ self.tool)


@dataclass(frozen=True)
class Part(Path):
    """What is left of a path after `begin`."""

    whole: Path
    begin: float

    @property
    def length(self) -> float:
        """Length of the rest."""
        return max(self.whole.length - self.begin, 0.0)

    @property
    def angular(self) -> bool:
        """The same as for the whole path."""
        return self.whole.angular

    @property
    def stretches(self) -> int:
        """The same as for the whole path."""
        return self.whole.stretches

    def pose(self, done: float) -> Pose:
        """Where the tip is."""
        return self.whole.pose(self.begin + done)

    def joints(self, done: float) -> Joints | None:
        """The same as for the whole path."""
        return self.whole.joints(self.begin + done)


def fixed(pose: Pose, fix: Matrix | None) -> Pose:
    """The true tip, from the tool centre point that was configured."""
    return pose if fix is None else pose_of(matrix_of(pose) @ fix)
