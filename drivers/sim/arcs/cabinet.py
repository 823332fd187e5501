"""The loopback cabinet: an arm's motion, tool, power, safety and watchdogs, independent of the wire protocol.

It simulates what a driver can get wrong: refusals by return code, poses that are accepted first and fail in planning, a
path that a protective stop keeps. It simulates neither accuracy nor safety functions.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np

from brushloop.drivers.arcs.controller import MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import from_wire, to_wire
from brushloop.drivers.sim.kinematics import Joints, Matrix, forward, inverse, inverted, matrix_of, pose_of
from brushloop.drivers.sim.world import World

BOOT_S = 0.7
POWER_ON_S = 1.0
"""Time from `poweron` to Idle."""
BRAKE_RELEASE_S = 1.0
POWER_OFF_S = 0.3

EMERGENCY_STOPS = frozenset({SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.ROBOT_EMERGENCY_STOP})


class Power:
    """Power and safety state. `now_s` is simulated time; each transition takes effect when it is due."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._steps: list[tuple[float, RobotMode]] = [(-1.0, RobotMode.POWER_OFF)]
        self.safety = SafetyMode.NORMAL
        self.button_down = False
        """Whether the emergency stop button is down; a person pushes and releases it."""

    @property
    def mode(self) -> RobotMode:
        """The robot mode now."""
        while len(self._steps) > 1 and self._steps[1][0] <= self._now_s():
            self._steps.pop(0)
        return self._steps[0][1]

    @property
    def on(self) -> bool:
        """True from PowerOn to Running."""
        return self.mode in {RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BRAKE_RELEASING, RobotMode.RUNNING}

    def power_on(self) -> int:
        """Request power; Idle comes `POWER_ON_S` later."""
        if self.safety in EMERGENCY_STOPS:
            return ReturnCode.BAD_STATE
        if self.mode == RobotMode.POWER_OFF:
            self._then((0.0, RobotMode.BOOTING), (BOOT_S, RobotMode.POWER_ON), (POWER_ON_S, RobotMode.IDLE))
        return ReturnCode.OK

    def start_up(self) -> int:
        """Request the brakes' release; Running comes `BRAKE_RELEASE_S` later."""
        if self.mode == RobotMode.RUNNING:
            return ReturnCode.OK
        if self.mode != RobotMode.IDLE or self.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        self._then((0.0, RobotMode.BRAKE_RELEASING), (BRAKE_RELEASE_S, RobotMode.RUNNING))
        return ReturnCode.OK

    def power_off(self) -> int:
        """Engage the brakes and switch the arm off."""
        if self.mode != RobotMode.POWER_OFF:
            self._then((0.0, RobotMode.POWERING_OFF), (POWER_OFF_S, RobotMode.POWER_OFF))
        return ReturnCode.OK

    def press_emergency_stop(self, mode: SafetyMode) -> None:
        """Push the button, as a person would: the power is off at once."""
        self.safety, self.button_down = mode, True
        self._then((0.0, RobotMode.POWER_OFF))

    def release_emergency_stop(self) -> None:
        """Release the button, as a person would. The board must then be restarted, then the power."""
        self.button_down = False

    def reset_safeguard(self) -> None:
        """Close and reset the safeguard at its input, as a person would; no method on the wire does this."""
        if self.safety == SafetyMode.SAFEGUARD_STOP:
            self.safety = SafetyMode.NORMAL

    def reduce(self, reduced: bool) -> None:
        """Switch reduced mode on or off by its input; ignored during a stop of any kind."""
        if self.safety in MOVING_ALLOWED:
            self.safety = SafetyMode.REDUCED if reduced else SafetyMode.NORMAL

    def unlock(self) -> int:
        """Clear a protective stop and nothing else. The arm does not resume by itself."""
        if self.safety != SafetyMode.PROTECTIVE_STOP:
            return ReturnCode.REQUEST_IGNORED if self.safety == SafetyMode.NORMAL else ReturnCode.BAD_STATE
        self.safety = SafetyMode.NORMAL
        return ReturnCode.OK

    def restart_interface_board(self) -> int:
        """Clear an emergency stop or a fault, once the button is released and the power is off."""
        if self.button_down or self.mode != RobotMode.POWER_OFF:
            return ReturnCode.BAD_STATE
        if self.safety in EMERGENCY_STOPS or self.safety == SafetyMode.FAULT:
            self.safety = SafetyMode.NORMAL
        return ReturnCode.OK

    def _then(self, *steps: tuple[float, RobotMode]) -> None:
        now_s = self._now_s()
        self._steps = [(now_s + after_s, mode) for after_s, mode in steps]


ROBOT = "rob1"
IK_NO_CONVERGE = -23
HARD_STOP_M_S2 = 10.0
SOFT_STOP_M_S2 = 2.0

Params = dict[str, Any]


class Cabinet:
    """State behind the controller's methods. The world decides where the tip is; the joints follow from it."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.motion = world.motion
        self.power = Power(self.now_s)
        self.tcp_offset = [0.0] * 6
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

    def safety_stop(self, mode: SafetyMode = SafetyMode.PROTECTIVE_STOP) -> None:
        """Enter a safety stop where the arm is. A protective stop keeps the path; only a person can clear a stop."""
        if mode in EMERGENCY_STOPS:
            self.emergency_stop(mode)
            return
        if self.power.safety in EMERGENCY_STOPS:
            return  # no lesser stop replaces it
        self.power.safety = mode
        if mode == SafetyMode.PROTECTIVE_STOP:
            self.hold(HARD_STOP_M_S2)
        else:
            self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)

    def emergency_stop(self, mode: SafetyMode = SafetyMode.ROBOT_EMERGENCY_STOP) -> None:
        """Stop as if a person had pushed the emergency stop button."""
        self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)
        self.power.press_emergency_stop(mode)

    def release(self) -> str:
        """End a safety stop as a person at the arm would; return the previous safety mode.

        A protective stop is unlocked at the pendant, and a safeguard stop is reset at its input. For an emergency stop,
        the button is released and the interface board restarted, which leaves the arm without power.
        """
        before = self.power.safety
        if before == SafetyMode.PROTECTIVE_STOP:
            self.power.unlock()
        elif before == SafetyMode.SAFEGUARD_STOP:
            self.power.reset_safeguard()
        elif before in EMERGENCY_STOPS:
            self.power.release_emergency_stop()
            self.power.restart_interface_board()
        return before.value

    def power_off(self) -> int:
        """Stop the arm, then switch its power off."""
        self.stop(HARD_STOP_M_S2, HARD_STOP_M_S2)
        return self.power.power_off()

    @property
    def tcp_offset(self) -> list[float]:
        """Flange to tool centre point as configured: [x, y, z m, rx, ry, rz rad]. The true tip stays where it is."""
        return self._tcp_offset

    @tcp_offset.setter
    def tcp_offset(self, offset: list[float]) -> None:
        self._tcp_offset = list(offset)
        tool = matrix_of(from_wire(offset))
        fix = inverted(tool) @ self.motion.tool
        self.fix = None if np.allclose(fix, np.eye(4), rtol=0.0, atol=1e-9) else fix
        """From the configured tool centre point to the true tip; None if they are the same."""
        self._tool = tool

    def tool(self) -> Matrix:
        """Flange to tool centre point, as configured."""
        return self._tool

    def tcp(self) -> Pose:
        """Pose of the configured tool centre point, which the controller takes for the tip."""
        return self.configured(self.world.tool())

    def configured(self, tip: Pose) -> Pose:
        """Where the configured tool centre point is when the true tip is there."""
        return tip if self.fix is None else pose_of(matrix_of(tip) @ inverted(self.fix))

    def joints(self) -> Joints:
        """Joint positions for the present pose of the tip."""
        return self.motion.joints(self.now_s())

    def fk(self, q: list[float]) -> list[Any]:
        """[pose of the configured tool centre point, return code]."""
        return [to_wire(pose_of(forward([float(v) for v in q]) @ self.tool())), 0]

    def ik(self, near: list[float], pose: list[float]) -> list[Any]:
        """[joints, return code]; the joints are `near` if there is no solution."""
        target = matrix_of(from_wire([float(v) for v in pose]))
        joints = inverse(target @ inverted(self.tool()), near)
        return [list(near), IK_NO_CONVERGE] if joints is None else [list(joints), 0]

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
        """Resume a path that was held. Refused while a safety stop lasts."""
        if self.power.mode != RobotMode.RUNNING:
            return -1
        if self.power.safety not in MOVING_ALLOWED:
            return ReturnCode.BAD_STATE
        self.motion.resume(self.now_s())
        return ReturnCode.OK

    def set_speed_fraction(self, fraction: float) -> int:
        """Scale the speed of every move that has not begun."""
        if not 0.0 < fraction <= 1.0:
            return -ReturnCode.INVALID_ARGUMENT
        self.motion.set_fraction(fraction, self.now_s())
        return ReturnCode.OK

    def set_watchdog(self, key: str, timeout_s: float, action: int) -> int:
        """Restart the watchdog `key` from now; action 0 ends it. It counts real time, as its client does."""
        if action not in (0, 1, 2, 3) or not timeout_s >= 0.1:
            return -ReturnCode.INVALID_ARGUMENT
        if (timer := self._timers.pop(key, None)) is not None:
            timer.cancel()
        self.watchdogs[key] = (timeout_s, action)
        if action:
            self._timers[key] = asyncio.get_running_loop().call_later(timeout_s, self._fire, key, action)
        return ReturnCode.OK

    def close(self) -> None:
        """End the watchdogs' timers."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()

    def _fire(self, key: str, action: int) -> None:
        self._timers.pop(key, None)
        match action:
            case 1:
                self.hold()
            case 2:
                self.stop(SOFT_STOP_M_S2, SOFT_STOP_M_S2)
            case _:
                self.safety_stop(SafetyMode.PROTECTIVE_STOP)
