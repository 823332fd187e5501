"""The loopback cabinet's power and safety states: their delays, and the stops that only a person may clear."""

from __future__ import annotations

from collections.abc import Callable

from brushloop.drivers.arcs.codes import MOVING_ALLOWED, ReturnCode, RobotMode, SafetyMode

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
