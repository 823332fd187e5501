"""Return codes, modes and errors of ARCS, and what each means for the person at the arm.

MotionError
 +-- WrongOperationalMode   the pendant's mode switch is not on Automatic
 +-- MotionRefused
 |    +-- QueueFull         another client fills the controller's queue
 +-- MotionFailed
      +-- OutOfReach        accepted, then failed in planning: messages 30047 and 30048
"""

from __future__ import annotations

from enum import IntEnum, StrEnum

from brushloop.drivers.errors import MotionError, MotionFailed, MotionRefused

LOOPBACK_CONTROL_BOX = "brushloop-loopback"
"""What the loopback controller answers to `getControlBoxType`; no maker uses that name."""


class ReturnCode(IntEnum):
    """What move commands return: 0 is success, positive a warning, negative an error of the same number."""

    OK = 0
    BAD_STATE = 1
    QUEUE_FULL = 2
    BUSY = 3
    TIMEOUT = 4
    INVALID_ARGUMENT = 5
    NOT_IMPLEMENTED = 6
    NO_ACCESS = 7
    REQUEST_IGNORED = 13


class RobotMode(StrEnum):
    """`getRobotModeType`; the spelling is the controller's."""

    NO_CONTROLLER = "NoController"
    DISCONNECTED = "Disconnected"
    CONFIRM_SAFETY = "ConfirmSafety"
    BOOTING = "Booting"
    POWER_OFF = "PowerOff"
    POWER_ON = "PowerOn"
    IDLE = "Idle"
    BRAKE_RELEASING = "BrakeReleasing"
    BACK_DRIVE = "BackDrive"
    RUNNING = "Running"
    MAINTENANCE = "Maintaince"
    ERROR = "Error"
    POWERING_OFF = "PowerOffing"


class SafetyMode(StrEnum):
    """`getSafetyModeType`."""

    UNDEFINED = "Undefined"
    NORMAL = "Normal"
    REDUCED = "ReducedMode"
    RECOVERY = "Recovery"
    VIOLATION = "Violation"
    PROTECTIVE_STOP = "ProtectiveStop"
    SAFEGUARD_STOP = "SafeguardStop"
    SYSTEM_EMERGENCY_STOP = "SystemEmergencyStop"
    ROBOT_EMERGENCY_STOP = "RobotEmergencyStop"
    FAULT = "Fault"


MOVING_ALLOWED = frozenset({SafetyMode.NORMAL, SafetyMode.REDUCED})

# No software here clears any of them: a person looks first.
CONDITION_AND_REMEDY: dict[SafetyMode, tuple[str, str]] = {
    SafetyMode.PROTECTIVE_STOP: (
        "The arm is powered, brakes open, and still holds its path.",
        "Find the cause, lift the brush clear, release the protective stop on the pendant.",
    ),
    SafetyMode.SAFEGUARD_STOP: (
        "The arm is powered with brakes on; its path is dropped.",
        "Close the safeguard and reset it at its own input.",
    ),
    SafetyMode.SYSTEM_EMERGENCY_STOP: (
        "The arm has no power and its brakes are on.",
        "Release the system's emergency stop, restart the interface board, power on and start up.",
    ),
    SafetyMode.ROBOT_EMERGENCY_STOP: (
        "The arm has no power and its brakes are on.",
        "Release the pendant's emergency stop, restart the interface board, power on and start up.",
    ),
}
UNKNOWN_CONDITION = (
    "The arm may have stopped anywhere on its path.",
    "Look at the pendant before doing anything else.",
)


def refusal(code: int) -> tuple[str, str]:
    """(name, remedy) of a move command's return code."""
    known = {member.value: member.name for member in ReturnCode}
    name = known.get(abs(code), "UNKNOWN")
    remedies = {
        ReturnCode.BAD_STATE: "Bring the safety mode to Normal on the pendant.",
        ReturnCode.QUEUE_FULL: "Another client is sending motion; close it.",
        ReturnCode.BUSY: "Another program has the arm; stop it on the pendant.",
        ReturnCode.INVALID_ARGUMENT: "Report this as a defect: the controller refuses an argument of the driver.",
    }
    return name, remedies.get(ReturnCode(abs(code)), "") if abs(code) in known else ""


class WrongOperationalMode(MotionError):
    """A program may not move the arm in this operational mode; `mode` is the controller's name for it."""

    def __init__(self, device: str, op: str, mode: str) -> None:
        self.mode = mode
        super().__init__(
            device,
            op,
            f"operational mode is {mode}",
            condition="Nothing was set or powered.",
            remedy="Turn it to Automatic on the pendant; no software here does that.",
        )


class QueueFull(MotionRefused):
    """The controller's queue has no room, although this driver queues few lines and waits."""


class OutOfReach(MotionFailed):
    """The controller accepted a target and could not plan a path to it; `code` is the number of its message."""

    def __init__(self, device: str, op: str, code: int, name: str) -> None:
        self.code = code
        super().__init__(
            device,
            op,
            f"the controller reports {code} ({name})",
            condition="A stop was sent to the arm.",
            remedy="Bring the target within reach: move the sheet or turn the brush, then teach again.",
        )
