"""The loopback cabinet: an arm's motion, tool, safety and watchdogs, whoever asks for them and however.

It keeps the parts that a driver can get wrong: refusals by return code, poses that are accepted first and fail in
planning, a path that a protective stop keeps. It fakes no accuracy and no safety function.
"""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np

from drivers.arcs.codes import MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from drivers.geometry import from_wire, to_wire
from drivers.samples import Pose
from drivers.sim.arcs_io import DigitalIo
from drivers.sim.arcs_motion import ArmQueue
from drivers.sim.arcs_power import Power
from drivers.sim.kinematics import LIMITS_DEG, Joints, Matrix, forward, inverse, matrix_of, pose_of
from drivers.sim.world import World

ROBOT = "rob1"
POSE_OUT_OF_REACH = 30047
IK_NO_CONVERGE = -23
HARD_STOP_M_S2 = 10.0
SOFT_STOP_M_S2 = 2.0
BRISTLES_N_MM = 0.05
"""How hard the brush pushes back: enough to be seen, far from what stops an arm."""

Params = dict[str, Any]


class Cabinet:
    """What the methods of the controller act on. The tip is where the world says; the joints follow from it."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.motion = world.motion = ArmQueue.instead_of(world.motion)
        self.power = Power(self.now_s)
        self.io = DigitalIo()
        self.tcp_offset: list[float] = [0.0] * 6
        self.payload: list[Any] = [0.0, [0.0] * 3, [0.0] * 3, [0.0] * 6]
        self.collision_level = 6
        self.operational_mode = "Automatic"
        self.messages: list[dict[str, Any]] = []
        self.watchdogs: dict[str, tuple[float, int]] = {}
        """(timeout in real seconds, action) by key."""
        self._timers: dict[str, asyncio.TimerHandle] = {}

    def now_s(self) -> float:
        """Simulated time."""
        return self.world.clock.now_s()

    def tell(self, code: int, *args: str) -> None:
        """Put a message where `Trace.peek` finds it."""
        stamp = max(int(self.now_s() * 1e9), self.messages[-1]["timestamp"] + 1 if self.messages else 1)
        self.messages.append({"code": code, "level": "ERROR", "source": ROBOT, "args": list(args), "timestamp": stamp})

    def safety_stop(self, mode: SafetyMode) -> None:
        """Enter a safety stop where the arm is. A protective stop keeps the path; only a person clears any of them."""
        self.power.safety = mode
        if mode == SafetyMode.PROTECTIVE_STOP:
            self.hold(HARD_STOP_M_S2)
        else:
            self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)

    def collide(self) -> None:
        """The arm hits something: a protective stop that says so."""
        self.power.collision = True
        self.safety_stop(SafetyMode.PROTECTIVE_STOP)

    def emergency_stop(self, mode: SafetyMode = SafetyMode.ROBOT_EMERGENCY_STOP) -> None:
        """A person pushes the button."""
        self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)
        self.power.press_emergency_stop(mode)

    def power_off(self) -> int:
        """Stop, then take the power away."""
        self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)
        return self.power.power_off()

    def tool(self) -> Matrix:
        """Flange to tip, as configured."""
        return matrix_of(from_wire(self.tcp_offset))

    def joints(self) -> Joints:
        """The joints that put the tip where it is."""
        exact = self.motion.joints(self.now_s())
        return exact or self.motion.seen(self.world.tool(), self.tool())

    def flange(self) -> Pose:
        """Where the flange is."""
        return pose_of(matrix_of(self.world.tool()) @ np.linalg.inv(self.tool()))

    def force(self) -> list[float]:
        """[Fx, Fy, Fz N, Mx, My, Mz Nm] in the base frame: the bristles' push while the tip is below the paper."""
        tip, table = self.world.tool(), self.world.config.table
        x_mm, y_mm = self.world.to_paper(tip.x_mm, tip.y_mm)
        on_sheet = 0.0 <= x_mm <= table.sheet_mm[0] and 0.0 <= y_mm <= table.sheet_mm[1]
        depth_mm = max(table.paper_z_mm - tip.z_mm, 0.0) if on_sheet else 0.0
        return [0.0, 0.0, BRISTLES_N_MM * depth_mm, 0.0, 0.0, 0.0]

    def fk(self, q: list[float], *, tip: bool) -> list[Any]:
        """[pose, return code]."""
        flange = forward([float(v) for v in q])
        return [to_wire(pose_of(flange @ self.tool() if tip else flange)), 0]

    def ik(self, near: list[float], pose: list[float]) -> list[Any]:
        """[joints, return code]; the joints are `near` where there is no solution."""
        found = inverse(matrix_of(from_wire([float(v) for v in pose])) @ np.linalg.inv(self.tool()), near)
        return [list(near), IK_NO_CONVERGE] if found is None else [list(found), 0]

    def move_line(self, p: Params) -> int:
        """Queue a line, or refuse it; a pose out of reach is accepted and fails in planning."""
        target = from_wire([float(v) for v in p["pose"]])
        acc, speed, duration_s = float(p["a"]), float(p["v"]), float(p.get("duration", 0.0))
        if (code := self._admit(acc, speed, float(p.get("blend_radius", 0.0)))) != ReturnCode.OK:
            return code
        if inverse(matrix_of(target) @ np.linalg.inv(self.tool()), self.motion.near) is None:
            return self._out_of_reach()
        added = self.motion.add(target, speed * 1e3, acc * 1e3, self.now_s(), duration_s)
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def move_joint(self, p: Params) -> int:
        """Queue a joint move, or refuse it; joints beyond their limits are accepted and fail in planning."""
        q = [float(v) for v in p["q"]]
        acc, speed, duration_s = float(p["a"]), float(p["v"]), float(p.get("duration", 0.0))
        if len(q) != 6 or not all(math.isfinite(v) for v in q):
            return -ReturnCode.INVALID_ARGUMENT
        if (code := self._admit(acc, speed, float(p.get("blend_radius", 0.0)))) != ReturnCode.OK:
            return code
        if any(abs(v) > math.radians(limit) for v, limit in zip(q, LIMITS_DEG, strict=True)):
            return self._out_of_reach()
        self.joints()
        joints = (q[0], q[1], q[2], q[3], q[4], q[5])
        added = self.motion.add_joints(joints, self.tool(), speed, acc, self.now_s(), duration_s)
        return ReturnCode.OK if added else ReturnCode.REQUEST_IGNORED

    def stop(self, acc_m_s2: float, acc_rad_s2: float) -> int:
        """Decelerate and forget the path."""
        if not (acc_m_s2 > 0.0 and acc_rad_s2 > 0.0):
            return -ReturnCode.INVALID_ARGUMENT
        self.motion.stop(acc_m_s2 * 1e3, acc_rad_s2, self.now_s())
        return ReturnCode.OK

    def hold(self, acc_m_s2: float = SOFT_STOP_M_S2) -> int:
        """Decelerate and keep the path."""
        self.motion.hold(acc_m_s2 * 1e3, acc_m_s2, self.now_s())
        return ReturnCode.OK

    def resume(self) -> int:
        """Go on with a path that was held. Refused while a safety stop lasts."""
        if self.power.mode != RobotMode.RUNNING:
            return -1
        if self.power.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        self.motion.resume(self.now_s())
        return ReturnCode.OK

    def set_speed_fraction(self, fraction: float) -> int:
        """For every move that has not begun."""
        if not 0.0 < fraction <= 1.0:
            return -ReturnCode.INVALID_ARGUMENT
        self.motion.set_fraction(fraction, self.now_s())
        return ReturnCode.OK

    def set_watchdog(self, key: str, timeout_s: float, action: int) -> int:
        """Start it again from now; action 0 ends it. Its time is real time, as its client's is."""
        if action not in (0, 1, 2, 3) or not timeout_s >= 0.1:
            return -ReturnCode.INVALID_ARGUMENT
        if (timer := self._timers.pop(key, None)) is not None:
            timer.cancel()
        self.watchdogs[key] = (timeout_s, action)
        if action:
            self._timers[key] = asyncio.get_running_loop().call_later(timeout_s, self._bite, key, action)
        return ReturnCode.OK

    def close(self) -> None:
        """End the watchdogs' timers."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()

    def _bite(self, key: str, action: int) -> None:
        self._timers.pop(key, None)
        match action:
            case 1:
                self.hold()
            case 2:
                self.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
            case _:
                self.safety_stop(SafetyMode.PROTECTIVE_STOP)

    def _admit(self, acc: float, speed: float, blend_m: float) -> int:
        if self.power.mode != RobotMode.RUNNING:
            return -1
        if self.power.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        if not (acc > 0.0 and speed > 0.0) or not (blend_m == 0.0 or 0.001 <= blend_m <= 1.0):
            return -ReturnCode.INVALID_ARGUMENT
        return ReturnCode.QUEUE_FULL if self.motion.full else ReturnCode.OK

    def _out_of_reach(self) -> int:
        self.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
        self.tell(POSE_OUT_OF_REACH)
        return ReturnCode.OK
