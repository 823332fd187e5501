"""Paths of the loopback arm's tip: lines in space and in joints, corners between lines, and speed along them.

Lengths are in mm, or in rad where a path is angular.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import distance, interpolate
from brushloop.drivers.sim.arm.kinematics import Joints, Matrix, forward, matrix_of, pose_of

ROTATION_AS_LINEAR_MM = 1.0
"""Below this travel, ARCS reads speed and acceleration as rad/s and rad/s2."""
TURN_RAD = 1e-4
STRETCHES = 16
"""Number of straight pieces in which a curved path is reported to the world."""


def fixed(pose: Pose, fix: Matrix | None) -> Pose:
    """The true tip, from the tool centre point that was configured."""
    return pose if fix is None else pose_of(matrix_of(pose) @ fix)


@dataclass(frozen=True)
class Line:
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
class Corner:
    """The parabola that leaves `a` at `cut` before its end and meets `b` at `cut` after its start, turns included."""

    a: Line
    b: Line
    cut: float
    angular = False
    stretches = STRETCHES

    @property
    def length(self) -> float:
        """Length that the corner replaces; the curve itself is shorter."""
        return 2.0 * self.cut

    @cached_property
    def bend(self) -> float:
        """Length of the difference of the two unit directions: 0 for straight on, 2 for a reversal."""
        directions = [np.subtract(w.end.position_mm, w.start.position_mm) / w.length for w in (self.a, self.b)]
        return float(np.linalg.norm(directions[1] - directions[0]))

    def pose(self, done: float) -> Pose:
        """Where the true tip is after `done`, by de Casteljau's algorithm."""
        u = done / self.length
        start, end = self.a.along(self.a.length - self.cut), self.b.along(self.cut)
        there = interpolate(interpolate(start, self.a.end, u), interpolate(self.b.start, end, u), u)
        return fixed(there, self.a.fix)


@dataclass(frozen=True)
class JointLine:
    """Straight in joints; its length is the angle of the joint that turns farthest."""

    start: Joints
    end: Joints
    tool: Matrix
    angular = True
    stretches = STRETCHES

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


@dataclass(frozen=True, slots=True)
class Ramp:
    """A speed profile: from `v_in` at `acc` to `speed`, then at `acc` to `v_out`; a short path does not reach `speed`.

    Time is in s. `v_in` and `v_out` must be within reach of each other.
    """

    length: float
    speed: float
    acc: float
    v_in: float = 0.0
    v_out: float = 0.0

    @property
    def peak(self) -> float:
        """The speed between the two slopes."""
        if self.v_in >= self.speed:
            return max(self.speed, self.v_out)
        if not self.length:
            return self.v_in
        highest = math.sqrt(self.acc * self.length + 0.5 * (self.v_in * self.v_in + self.v_out * self.v_out))
        return max(min(self.speed, highest), self.v_in, self.v_out)

    @property
    def duration_s(self) -> float:
        """Time for the whole length."""
        return sum(self._times())

    def at(self, t: float) -> tuple[float, float]:
        """(distance, speed) at time `t`, clamped to the ends."""
        if t <= 0.0:
            return 0.0, self.v_in
        up_s, along_s, down_s = self._times()
        if t >= up_s + along_s + down_s:
            return self.length, self.v_out
        peak = self.peak
        if t < up_s:
            slope = math.copysign(self.acc, peak - self.v_in)
            return self.v_in * t + 0.5 * slope * t * t, self.v_in + slope * t
        if t >= up_s + along_s:
            left = up_s + along_s + down_s - t
            return self.length - self.v_out * left - 0.5 * self.acc * left * left, self.v_out + self.acc * left
        return 0.5 * (self.v_in + peak) * up_s + peak * (t - up_s), peak

    def _times(self) -> tuple[float, float, float]:
        if not self.length:
            return 0.0, 0.0, 0.0
        peak = self.peak
        up_s, down_s = abs(peak - self.v_in) / self.acc, (peak - self.v_out) / self.acc
        along = self.length - 0.5 * (self.v_in + peak) * up_s - 0.5 * (self.v_out + peak) * down_s
        return up_s, max(along, 0.0) / peak, down_s
