"""Moves as clients queue them: lines, moves in joints, circles and splines, and what is told of them.

A pose out of reach is accepted first and fails in planning, as in a controller. Speeds above what the arm allows are
clipped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivers.arcs.codes import ReturnCode
from drivers.geometry import from_wire
from drivers.sim.arcs.admission import Admission, six, within
from drivers.sim.arcs.cabinet import SOFT_STOP_M_S2, Cabinet
from drivers.sim.arcs.limits import (
    JOINT_ACCS_RAD_S2,
    JOINT_SPEEDS_RAD_S,
    REDUCED_M_S,
    REDUCED_RAD_S,
    TCP_ACC_M_S2,
    TCP_SPEED_M_S,
)
from drivers.sim.arcs.motion import Pace

Params = dict[str, Any]


class Moves(Admission):
    """The queue of one cabinet."""

    def __init__(self, cabinet: Cabinet) -> None:
        super().__init__(cabinet)
        self._circle_mode = 1

    def methods(self) -> dict[str, Callable[[Params], Any]]:
        """By `MotionControl.method`."""
        cabinet, motion = self.cabinet, self.cabinet.motion
        return {
            "MotionControl.moveLine": self.line,
            "MotionControl.moveJoint": self.joint,
            "MotionControl.moveCircle": self.circle,
            "MotionControl.setCirclePathMode": self._set_circle_mode,
            "MotionControl.moveSpline": self.spline,
            "MotionControl.stopLine": lambda p: cabinet.stop(float(p["acc"]), float(p["acc_rot"])),
            "MotionControl.stopJoint": lambda p: cabinet.stop(SOFT_STOP_M_S2, float(p["acc"])),
            "MotionControl.clearPath": lambda _: cabinet.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2),
            "MotionControl.stopMove": lambda _: cabinet.hold(),
            "MotionControl.startMove": lambda _: cabinet.resume(),
            "MotionControl.setSpeedFraction": lambda p: cabinet.set_speed_fraction(float(p["fraction"])),
            "MotionControl.getSpeedFraction": lambda _: motion.fraction,
            "MotionControl.getExecId": lambda _: motion.exec_id(cabinet.now_s()),
            "MotionControl.getQueueSize": lambda _: self.queue_size(),
            "MotionControl.getTrajectoryQueueSize": lambda _: self.queue_size(),
            "MotionControl.isBlending": lambda _: motion.blending(cabinet.now_s()),
            "MotionControl.getProgress": lambda _: motion.progress(cabinet.now_s()),
            "MotionControl.getDuration": lambda p: motion.times(int(p["id"]), cabinet.now_s())[0],
            "MotionControl.getMotionLeftTime": lambda p: motion.times(int(p["id"]), cabinet.now_s())[1],
            "MotionControl.getPauseJointPositions": lambda _: cabinet.joints() if motion.held else [],
        }

    def line(self, p: Params) -> int:
        """moveLine."""
        target = from_wire([float(v) for v in p["pose"]])
        if (code := self.admit(p)) != ReturnCode.OK:
            return code
        if not self.reachable(target):
            return self.out_of_reach()
        pace = self.pace(p, TCP_SPEED_M_S, TCP_ACC_M_S2, REDUCED_M_S)
        cabinet = self.cabinet
        added = cabinet.motion.add(
            target,
            pace.speed * 1e3,
            pace.acc * 1e3,
            cabinet.now_s(),
            pace.duration_s,
            blend_mm=pace.blend_mm,
            fix=cabinet.fix,
        )
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def joint(self, p: Params) -> int:
        """moveJoint."""
        q = six(p["q"])
        if q is None:
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self.admit(p)) != ReturnCode.OK:
            return code
        if not within(q):
            return self.out_of_reach()
        added = self.cabinet.motion.add_joints(q, self._joint_pace(p), self.cabinet.now_s())
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def circle(self, p: Params) -> int:
        """moveCircle: one arc; every circle begins and ends at rest."""
        via, end = (from_wire([float(v) for v in p[name]]) for name in ("via_pose", "end_pose"))
        if (code := self.admit(p)) != ReturnCode.OK:
            return code
        if not (self.reachable(via) and self.reachable(end)):
            return self.out_of_reach()
        pace, cabinet = self.pace(p, TCP_SPEED_M_S, TCP_ACC_M_S2, REDUCED_M_S), self.cabinet
        pace = Pace(pace.speed * 1e3, pace.acc * 1e3, pace.duration_s)
        try:
            cabinet.motion.add_arc(via, end, self._circle_mode, cabinet.fix, pace, cabinet.now_s())
        except ValueError:
            return -ReturnCode.INVALID_ARGUMENT
        return ReturnCode.OK

    def spline(self, p: Params) -> int:
        """moveSpline: points are collected; an empty one ends the spline, and with it the motion begins."""
        q = six(p["q"]) if p["q"] else None
        if p["q"] and q is None:
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self.admit(p)) != ReturnCode.OK:
            return code
        if q is not None:
            if not within(q):
                return self.out_of_reach()
            self.cabinet.motion.spline_through(q, self.cabinet.now_s())
            return ReturnCode.OK
        added = self.cabinet.motion.add_spline(self._joint_pace(p), self.cabinet.now_s())
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def _set_circle_mode(self, p: Params) -> int:
        if p["mode"] not in (0, 1, 2):
            return -ReturnCode.INVALID_ARGUMENT
        self._circle_mode = int(p["mode"])
        return ReturnCode.OK

    def _joint_pace(self, p: Params) -> Pace:
        return self.pace(p, min(JOINT_SPEEDS_RAD_S), min(JOINT_ACCS_RAD_S2), REDUCED_RAD_S)
