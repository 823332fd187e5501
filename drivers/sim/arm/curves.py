"""The curved ways of the loopback arm's tip: arcs in space, splines in joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from drivers.geometry import interpolate
from drivers.samples import Pose
from drivers.sim.arm.kinematics import Joints, Matrix, forward, pose_of
from drivers.sim.arm.paths import STRETCHES, fixed

ARC_STEP_RAD = math.radians(5.0)


@dataclass(frozen=True)
class Arc:
    """A circle from `start` through `via` to `end`. Raises ValueError where the three are on a line.

    `mode` is ARCS' circle path mode: 0 the tool turns with the path, 1 from start to end about one axis, 2 by way of
    the orientation at `via`.
    """

    start: Pose
    via: Pose
    end: Pose
    mode: int = 1
    fix: Matrix | None = None
    angular: bool = False
    _centre: NDArray[np.float64] = field(init=False)
    _axis: NDArray[np.float64] = field(init=False)
    _via_rad: float = field(init=False)
    sweep_rad: float = field(init=False)

    def __post_init__(self) -> None:
        a, b, c = (np.array(p.position_mm) for p in (self.start, self.via, self.end))
        ab, ac = b - a, c - a
        normal = np.cross(ab, ac)
        square = float(normal @ normal)
        if square < 1e-6 * float(ab @ ab) * float(ac @ ac) or not square:
            raise ValueError("start, via and end of a circle are on one line")
        centre = a + np.cross(float(ab @ ab) * ac - float(ac @ ac) * ab, normal) * 0.5 / square
        axis = normal / math.sqrt(square)
        spoke = a - centre
        ends = (b - centre, c - centre)
        angles = [math.atan2(float(np.cross(spoke, end) @ axis), float(spoke @ end)) for end in ends]
        via_rad, sweep_rad = (v % (2 * math.pi) for v in angles)
        for name, value in (("_centre", centre), ("_axis", axis), ("_via_rad", via_rad), ("sweep_rad", sweep_rad)):
            object.__setattr__(self, name, value)

    @cached_property
    def radius_mm(self) -> float:
        """Of the circle."""
        return float(np.linalg.norm(np.subtract(self.start.position_mm, self._centre)))

    @property
    def length(self) -> float:
        """In mm."""
        return self.radius_mm * self.sweep_rad

    @property
    def stretches(self) -> int:
        """One for every five degrees."""
        return max(math.ceil(self.sweep_rad / ARC_STEP_RAD), 1)

    def pose(self, done: float) -> Pose:
        """Where the true tip is."""
        if done >= self.length and self.mode:
            return fixed(self.end, self.fix)
        angle = min(done / self.radius_mm, self.sweep_rad)
        swing = Rotation.from_rotvec(angle * self._axis)
        x, y, z = (float(v) for v in self._centre + swing.apply(np.subtract(self.start.position_mm, self._centre)))
        if self.mode == 0:
            turn = swing * Rotation.from_quat(self.start.quaternion)
            qx, qy, qz, qw = (float(v) for v in turn.as_quat())
            return fixed(Pose(x, y, z, qx, qy, qz, qw), self.fix)
        if self.mode == 1:
            there = interpolate(self.start, self.end, angle / self.sweep_rad)
        elif angle <= self._via_rad:
            there = interpolate(self.start, self.via, angle / self._via_rad)
        else:
            there = interpolate(self.via, self.end, (angle - self._via_rad) / (self.sweep_rad - self._via_rad))
        return fixed(Pose(x, y, z, *there.quaternion), self.fix)

    def joints(self, done: float) -> Joints | None:
        """None: not given in joints."""
        return None


class Spline:
    """A natural cubic spline through joint positions; its length is the sum of the largest turns between them."""

    angular = True

    def __init__(self, points: Sequence[Joints], tool: Matrix) -> None:
        table = np.array(points)
        turns = np.abs(np.diff(table, axis=0)).max(axis=1)
        self._knots = np.concatenate([[0.0], np.cumsum(turns)])
        self._curve = CubicSpline(self._knots, table, bc_type="natural")
        self._tool = tool
        self.stretches = STRETCHES * len(turns)
        self.length = float(self._knots[-1])
        fine = np.linspace(0.0, self.length, 32 * len(turns) + 1)
        self.steepest = max(float(np.abs(self._curve(fine, 1)).max()), 1.0)
        """The fastest joint over the speed along the way."""
        self.sharpest = float(np.abs(self._curve(self._knots, 2)).max())
        """The largest second derivative; it is linear between the points, so it is at one of them."""

    def joints(self, done: float) -> Joints:
        """The joints after `done`."""
        q = [float(v) for v in self._curve(min(max(done, 0.0), self.length))]
        return (q[0], q[1], q[2], q[3], q[4], q[5])

    def pose(self, done: float) -> Pose:
        """Where the tip is."""
        return pose_of(forward(self.joints(done)) @ self._tool)
