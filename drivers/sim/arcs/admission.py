"""Who may move the loopback arm, how fast, and where to: the rules that all its motion has in common."""

from __future__ import annotations

import math
from typing import Any

from drivers.arcs.codes import MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from drivers.samples import Pose
from drivers.sim.arcs.cabinet import SOFT_STOP_M_S2, Cabinet
from drivers.sim.arcs.motion import Pace
from drivers.sim.arm.kinematics import LIMITS_DEG, Joints, inverse, inverted, matrix_of

Params = dict[str, Any]
POSE_OUT_OF_REACH = 30047
BLEND_M = (0.001, 1.0)


class Admission:
    """The rules of one cabinet."""

    def __init__(self, cabinet: Cabinet) -> None:
        self.cabinet = cabinet
        self._near = cabinet.motion.near
        """Joints of the last pose that was asked for: the next one is likely to be near."""

    def admit_any(self) -> int:
        """Whether the arm may move at all."""
        if self.cabinet.power.mode != RobotMode.RUNNING:
            return -1
        return ReturnCode.OK if self.cabinet.power.safety in MOVING_ALLOWED else ReturnCode.BAD_STATE

    def admit(self, p: Params) -> int:
        """Whether a move may be queued."""
        if (code := self.admit_any()) != ReturnCode.OK:
            return code
        acc, speed, duration_s = float(p["a"]), float(p["v"]), float(p.get("duration", 0.0))
        blend_m = float(p.get("blend_radius", 0.0))
        timed = math.isfinite(duration_s) and duration_s > 0.0  # then a and v may be left at 0
        if not (duration_s == 0.0 or timed) or math.isnan(acc) or math.isnan(speed):
            return -ReturnCode.INVALID_ARGUMENT
        if not (timed or (acc > 0.0 and speed > 0.0)) or not (blend_m == 0.0 or BLEND_M[0] <= blend_m <= BLEND_M[1]):
            return -ReturnCode.INVALID_ARGUMENT
        if self.cabinet.servo_mode or self.cabinet.motion.drifting(self.cabinet.now_s()):
            return ReturnCode.BUSY
        return ReturnCode.QUEUE_FULL if self.cabinet.motion.full else ReturnCode.OK

    def pace(self, p: Params, fastest: float, hardest: float, reduced: float) -> Pace:
        """Speed and acceleration, clipped to what the arm allows; the maxima where only a duration was given."""
        speed, acc, limit = float(p["v"]), float(p["a"]), self.allowed(fastest, reduced)
        return Pace(
            min(speed, limit) if speed > 0.0 else limit,
            min(acc, hardest) if acc > 0.0 else hardest,
            float(p.get("duration", 0.0)),
            float(p.get("blend_radius", 0.0)) * 1e3,
        )

    def allowed(self, fastest: float, reduced: float) -> float:
        """The fastest speed now: less in reduced mode and in manual operation."""
        slow = self.cabinet.power.safety == SafetyMode.REDUCED or self.cabinet.operational_mode == "Manual"
        return reduced if slow else fastest

    def joints_of(self, target: Pose, near: Joints) -> Joints | None:
        """Joints that bring the configured tool centre point to `target`."""
        return inverse(matrix_of(target) @ inverted(self.cabinet.tool()), near)

    def reachable(self, target: Pose) -> bool:
        """Whether there are joints for a pose of the configured tool centre point."""
        found = self.joints_of(target, self._near) or self.joints_of(target, self.cabinet.motion.near)
        self._near = found or self._near
        return found is not None

    def out_of_reach(self) -> int:
        """Accepted, then found to be out of reach: the arm stops and a message says why."""
        self.cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
        self.cabinet.tell(POSE_OUT_OF_REACH)
        return ReturnCode.OK

    def queue_size(self) -> int:
        """Moves that are not over."""
        self.cabinet.motion.advance(self.cabinet.now_s())
        return self.cabinet.motion.size


def six(values: Any) -> Joints | None:
    """Six finite numbers, or None."""
    q = [float(v) for v in values]
    return (q[0], q[1], q[2], q[3], q[4], q[5]) if len(q) == 6 and all(math.isfinite(v) for v in q) else None


def within(q: Joints) -> bool:
    """Whether joints are within their limits."""
    return all(abs(v) <= math.radians(limit) for v, limit in zip(q, LIMITS_DEG, strict=True))
