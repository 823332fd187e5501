"""Moves that clients queue for the loopback arm: when it may move, how fast and how far.

A pose out of reach is accepted first and fails in planning, as on a controller. Speeds above what the arm allows are
clipped. The joints' speeds are those of the maker's URDF for the i5; the other maxima are the examples in the SDK's
headers, which are for an i5H. A real cabinet reports its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from brushloop.drivers.arcs.codes import MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.geometry import from_wire
from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.arcs.cabinet import SOFT_STOP_M_S2, Cabinet
from brushloop.drivers.sim.arm.kinematics import LIMITS_DEG, Joints, inverse, inverted, matrix_of

JOINT_SPEEDS_RAD_S = (2.5964, 2.5964, 2.5964, 3.1105, 3.1105, 3.1105)
JOINT_ACCS_RAD_S2 = (31.1, 31.1, 31.1, 20.7, 20.7, 20.7)
TCP_SPEED_M_S, TCP_TURN_RAD_S = 2.0, 5.0
TCP_ACC_M_S2, TCP_TURN_RAD_S2 = 10.0, 10.0
REDUCED_M_S = 0.25
"""Limit in reduced mode and manual operation: ISO 10218-1's reduced speed, 250 mm/s. Configurable on a real cabinet."""
REACH_M = 0.8865
REDUCED_RAD_S = REDUCED_M_S / REACH_M
"""Joint speed at which the tip of the stretched arm stays below `REDUCED_M_S`."""
POSE_OUT_OF_REACH = 30047
BLEND_M = (0.001, 1.0)

Params = dict[str, Any]


class Moves:
    """The queue of one cabinet, and its limits."""

    def __init__(self, cabinet: Cabinet) -> None:
        self._cabinet = cabinet
        self._near = cabinet.motion.near
        """Joints of the last pose that was asked for: the next one is likely to be near."""

    def methods(self) -> dict[str, Callable[[Params], Any]]:
        """The methods by `Class.method`, without the robot's name."""
        cabinet, motion = self._cabinet, self._cabinet.motion
        return {
            "MotionControl.moveLine": self._line,
            "MotionControl.moveJoint": self._joint,
            "MotionControl.stopLine": lambda p: cabinet.stop(float(p["acc"]), float(p["acc_rot"])),
            "MotionControl.stopJoint": lambda p: cabinet.stop(SOFT_STOP_M_S2, float(p["acc"])),
            "MotionControl.stopMove": lambda _: cabinet.hold(),
            "MotionControl.startMove": lambda _: cabinet.resume(),
            "MotionControl.setSpeedFraction": lambda p: cabinet.set_speed_fraction(float(p["fraction"])),
            "MotionControl.getSpeedFraction": lambda _: motion.fraction,
            "MotionControl.getExecId": lambda _: motion.exec_id(cabinet.now_s()),
            "MotionControl.getQueueSize": lambda _: self._queue_size(),
        }

    def _line(self, p: Params) -> int:
        target = from_wire([float(v) for v in p["pose"]])
        if (code := self._admit(p)) != ReturnCode.OK:
            return code
        if not self._reachable(target):
            return self._out_of_reach()
        cabinet = self._cabinet
        speed_m_s, acc_m_s2 = self._pace(p, TCP_SPEED_M_S, TCP_ACC_M_S2, REDUCED_M_S)
        added = cabinet.motion.add(
            target,
            speed_m_s * 1e3,
            acc_m_s2 * 1e3,
            cabinet.now_s(),
            float(p.get("duration", 0.0)),
            blend_mm=float(p.get("blend_radius", 0.0)) * 1e3,
            fix=cabinet.fix,
        )
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def _joint(self, p: Params) -> int:
        q = [float(v) for v in p["q"]]
        if len(q) != 6 or not all(math.isfinite(v) for v in q):
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self._admit(p)) != ReturnCode.OK:
            return code
        if any(abs(v) > math.radians(limit) for v, limit in zip(q, LIMITS_DEG, strict=True)):
            return self._out_of_reach()
        speed_rad_s, acc_rad_s2 = self._pace(p, min(JOINT_SPEEDS_RAD_S), min(JOINT_ACCS_RAD_S2), REDUCED_RAD_S)
        joints: Joints = (q[0], q[1], q[2], q[3], q[4], q[5])
        least_s = float(p.get("duration", 0.0))
        added = self._cabinet.motion.add_joints(joints, speed_rad_s, acc_rad_s2, self._cabinet.now_s(), least_s)
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def _admit(self, p: Params) -> int:
        """Return code for queueing a move: OK if it may be queued."""
        if self._cabinet.power.mode != RobotMode.RUNNING:
            return -1
        if self._cabinet.power.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        acc, speed, duration_s = float(p["a"]), float(p["v"]), float(p.get("duration", 0.0))
        blend_m = float(p.get("blend_radius", 0.0))
        timed = math.isfinite(duration_s) and duration_s > 0.0  # then a and v may be left at 0
        if not (duration_s == 0.0 or timed) or math.isnan(acc) or math.isnan(speed):
            return -ReturnCode.INVALID_ARGUMENT
        if not (timed or (acc > 0.0 and speed > 0.0)) or not (blend_m == 0.0 or BLEND_M[0] <= blend_m <= BLEND_M[1]):
            return -ReturnCode.INVALID_ARGUMENT
        return ReturnCode.QUEUE_FULL if self._cabinet.motion.full else ReturnCode.OK

    def _pace(self, p: Params, fastest: float, hardest: float, reduced: float) -> tuple[float, float]:
        """Speed and acceleration, clipped to what the arm allows; the maxima if only a duration was given."""
        speed, acc = float(p["v"]), float(p["a"])
        slow = self._cabinet.power.safety == SafetyMode.REDUCED or self._cabinet.operational_mode == "Manual"
        limit = reduced if slow else fastest
        return min(speed, limit) if speed > 0.0 else limit, min(acc, hardest) if acc > 0.0 else hardest

    def _reachable(self, target: Pose) -> bool:
        """Whether the arm can reach a pose of the configured tool centre point."""
        flange = matrix_of(target) @ inverted(self._cabinet.tool())
        found = inverse(flange, self._near) or inverse(flange, self._cabinet.motion.near)
        self._near = found or self._near
        return found is not None

    def _out_of_reach(self) -> int:
        """Accept a move that then proves to be out of reach: the arm stops and a message says why."""
        self._cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
        self._cabinet.tell(POSE_OUT_OF_REACH)
        return ReturnCode.OK

    def _queue_size(self) -> int:
        self._cabinet.motion.advance(self._cabinet.now_s())
        return self._cabinet.motion.size
