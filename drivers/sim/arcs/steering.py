"""Motion that a client steers over the wire: velocities and servo steps.

They do not mix with queued moves or with each other: the one that comes second is told that the arm is busy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.arcs.codes import ReturnCode
from drivers.geometry import from_wire
from drivers.samples import Pose
from drivers.sim.arcs.admission import Admission, six, within
from drivers.sim.arcs.limits import (
    JOINT_ACCS_RAD_S2,
    JOINT_SPEEDS_RAD_S,
    REDUCED_M_S,
    REDUCED_RAD_S,
    TCP_ACC_M_S2,
    TCP_SPEED_M_S,
    TCP_TURN_RAD_S,
)
from drivers.sim.arm.drift import FOREVER_S
from drivers.sim.arm.kinematics import LIMITS_DEG

Params = dict[str, Any]
REACH_STEPS = 160
REACH_STEP_MM, REACH_STEP_RAD = 20.0, 0.05
JUMP_RAD = 0.6
"""Joints that differ by more over one such step are another branch: the arm cannot go there straight."""
MIN_STEP_S = 0.001


class Steering(Admission):
    """`speedLine`, `speedJoint` and servo mode of one cabinet."""

    def methods(self) -> dict[str, Callable[[Params], Any]]:
        """By `MotionControl.method`."""
        return {
            "MotionControl.speedLine": self.speed_line,
            "MotionControl.speedJoint": self.speed_joint,
            "MotionControl.setServoMode": lambda p: self.set_servo(1 if p["enable"] is True else 0),
            "MotionControl.setServoModeSelect": lambda p: self.set_servo(int(p["mode"])),
            "MotionControl.isServoModeEnabled": lambda _: self.cabinet.servo_mode > 0,
            "MotionControl.getServoModeSelect": lambda _: self.cabinet.servo_mode,
            "MotionControl.servoJoint": self.servo_joint,
            "MotionControl.servoCartesian": self.servo_cartesian,
        }

    def speed_line(self, p: Params) -> int:
        """speedLine in the base frame; it ends before the arm would leave its reach. It answers at once."""
        xd, acc, t = six(p["xd"]), float(p["a"]), float(p["t"])
        if xd is None or not acc > 0.0 or not t >= 0.0 or math.hypot(*xd[3:]) > TCP_TURN_RAD_S:
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self._admit_speed()) != ReturnCode.OK:
            return code
        share = min(1.0, self.allowed(TCP_SPEED_M_S, REDUCED_M_S) / max(math.hypot(*xd[:3]), 1e-12))
        velocity = [*(v * share * 1e3 for v in xd[:3]), *(v * share for v in xd[3:])]
        motion, now_s = self.cabinet.motion, self.cabinet.now_s()
        motion.drift(
            velocity, min(acc, TCP_ACC_M_S2) * 1e3, t, self._reach_s(velocity, min(acc, TCP_ACC_M_S2) * 1e3), now_s
        )
        return ReturnCode.OK

    def speed_joint(self, p: Params) -> int:
        """speedJoint; it ends before a joint would leave its range. It answers at once."""
        qd, acc, t = six(p["qd"]), float(p["a"]), float(p["t"])
        if qd is None or not acc > 0.0 or not t >= 0.0:
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self._admit_speed()) != ReturnCode.OK:
            return code
        fastest = [self.allowed(speed, REDUCED_RAD_S) for speed in JOINT_SPEEDS_RAD_S]
        share = min(1.0, *(limit / max(abs(v), 1e-12) for v, limit in zip(qd, fastest, strict=True)))
        velocity, acc = [v * share for v in qd], min(acc, *JOINT_ACCS_RAD_S2)
        motion, now_s = self.cabinet.motion, self.cabinet.now_s()
        motion.drift_joints(velocity, acc, t, self._joint_reach_s(velocity, acc), now_s)
        return ReturnCode.OK

    def set_servo(self, mode: int) -> int:
        """setServoModeSelect: 0 off, 1 planned, 2 and 3 pass-through; here all of them pass through."""
        if mode not in (0, 1, 2, 3):
            return -ReturnCode.INVALID_ARGUMENT
        if mode and (code := self.admit_any()) != ReturnCode.OK:
            return code
        if self.queue_size() and mode and not self.cabinet.servo_mode:
            return ReturnCode.BUSY
        self.cabinet.servo_mode = mode
        return ReturnCode.OK

    def servo_joint(self, p: Params) -> int:
        """servoJoint: be at `q` after `t`. Only these two count."""
        q, t = six(p["q"]), float(p["t"])
        if (code := self._admit_servo(t)) != ReturnCode.OK:
            return code
        fastest = self.allowed(min(JOINT_SPEEDS_RAD_S), REDUCED_RAD_S)
        if q is None or not within(q) or not self.cabinet.motion.servo_joints(q, t, fastest, self.cabinet.now_s()):
            return -ReturnCode.INVALID_ARGUMENT
        return ReturnCode.OK

    def servo_cartesian(self, p: Params) -> int:
        """servoCartesian: be at `pose` after `t`. Only these two count."""
        target, t, cabinet = from_wire([float(v) for v in p["pose"]]), float(p["t"]), self.cabinet
        if (code := self._admit_servo(t)) != ReturnCode.OK:
            return code
        fastest = self.allowed(TCP_SPEED_M_S, REDUCED_M_S) * 1e3
        if not self.reachable(target) or not cabinet.motion.servo(target, t, fastest, cabinet.now_s(), cabinet.fix):
            return -ReturnCode.INVALID_ARGUMENT
        return ReturnCode.OK

    def _admit_speed(self) -> int:
        if (code := self.admit_any()) != ReturnCode.OK:
            return code
        busy = self.queue_size() and not self.cabinet.motion.drifting(self.cabinet.now_s())
        return ReturnCode.BUSY if busy or self.cabinet.servo_mode else ReturnCode.OK

    def _admit_servo(self, t: float) -> int:
        if (code := self.admit_any()) != ReturnCode.OK:
            return code
        if not self.cabinet.servo_mode:
            return -ReturnCode.REQUEST_IGNORED
        if not (math.isfinite(t) and t >= MIN_STEP_S):
            return -ReturnCode.INVALID_ARGUMENT
        self.queue_size()
        return ReturnCode.QUEUE_FULL if self.cabinet.motion.full else ReturnCode.OK

    def _reach_s(self, velocity: Sequence[float], acc_mm_s2: float) -> float:
        """For how long the velocity may last, so that the arm comes to rest where it has joints all the way."""
        mm_s, rad_s = math.hypot(*velocity[:3]), math.hypot(*velocity[3:])
        if not mm_s and not rad_s:
            return max(MIN_STEP_S, self.cabinet.motion.settling_s(acc_mm_s2, self.cabinet.now_s()))
        step_s = min(REACH_STEP_MM / mm_s if mm_s else math.inf, REACH_STEP_RAD / rad_s if rad_s else math.inf)
        start, near = self.cabinet.tcp(), self.cabinet.joints()
        for k in range(1, REACH_STEPS + 1):
            found = self.joints_of(_moved(start, velocity, k * step_s), near)
            if found is None or max(abs(a - b) for a, b in zip(found, near, strict=True)) > JUMP_RAD:
                braking_s = 0.5 * max(mm_s, 1e3 * rad_s) / acc_mm_s2
                return max((k - 1) * step_s - braking_s, MIN_STEP_S)
            near = found
        return REACH_STEPS * step_s

    def _joint_reach_s(self, velocity: Sequence[float], acc_rad_s2: float) -> float:
        """For how long joint velocities may last, so that every joint comes to rest within its range."""
        if not any(velocity):
            return max(MIN_STEP_S, self.cabinet.motion.settling_s(acc_rad_s2, self.cabinet.now_s()))
        now = self.cabinet.motion.joint_velocity(self.cabinet.now_s())
        turning_s = max(abs(v - v0) for v, v0 in zip(velocity, now, strict=True)) / acc_rad_s2
        until_s = FOREVER_S
        for q, v, v0, limit_deg in zip(self.cabinet.joints(), velocity, now, LIMITS_DEG, strict=True):
            if v:
                ahead = math.copysign(1.0, v)
                room = math.radians(limit_deg) - ahead * q - 0.5 * (ahead * v0 - abs(v)) * turning_s
                until_s = min(until_s, room / abs(v) - 0.5 * abs(v) / acc_rad_s2)
        return max(until_s, MIN_STEP_S)


def _moved(start: Pose, velocity: Sequence[float], t: float) -> Pose:
    x, y, z = np.add(start.position_mm, np.multiply(velocity[:3], t))
    turn = Rotation.from_rotvec(np.multiply(velocity[3:], t)) * Rotation.from_quat(start.quaternion)
    qx, qy, qz, qw = (float(v) for v in turn.as_quat())
    return Pose(float(x), float(y), float(z), qx, qy, qz, qw)
