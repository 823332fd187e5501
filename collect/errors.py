"""Errors of a collection: each says what state it leaves and what must come next, and has the exit code of its run."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from brushloop.drivers.errors import (
    ArmMoved,
    DeviceError,
    LimitExceeded,
    MotionRefused,
    NotConnected,
    NotPowered,
    PathDisturbed,
    RobotNotSafe,
    SettingsChanged,
    too_busy,
)

NOT_AT_REST = "The arm was not seen at rest: it may still be moving. If it moves, press the red button."


class ConfigError(Exception):
    """A configuration cannot be used; nothing was powered and nothing moved."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path | str, field: str, what: str) -> None:
        self.path = str(path)
        self.field = field
        self.what = what
        super().__init__(f"{path}: {field}: {what}" if field else f"{path}: {what}")


class StepError(Exception):
    """A step failed in a defined way. The arm is at safe height, or the message says that it was stopped."""

    exit_code: ClassVar[int] = 4


class StepVoid(StepError):
    """A press did not go as planned. Leaves ink that must not count: never press that patch again."""


class BadPicture(StepError):
    """The photograph shows too little of the stroke, or what should not be in it. Leaves arm and stroke as they are."""


class ForceTooHigh(StepError):
    """The brush met something hard. Leaves the arm stopped, perhaps with the brush down; a person must look first."""

    def __init__(self, force_n: float, limit_n: float) -> None:
        super().__init__(
            f"the force reached {force_n:.2f} N, the ceiling is {limit_n:g} N: a stop was sent to the arm. "
            "Look at what is under the brush before going on."
        )


class NeedsOperator(StepError):
    """A person must act first; the message says how. Leaves the arm where the step began, at safe height."""


class CameraLate(NeedsOperator):
    """Photographs may be older than they seem. Leaves the arm parked; nothing was pressed meanwhile."""

    def __init__(self, text: str) -> None:
        super().__init__(f"{too_busy()} {text}".strip())


class SheetFull(StepError):
    """No free patch is left. Leaves the arm parked; a fresh sheet must be put in before the next press."""

    def __init__(self, capacity: int, sheet: int) -> None:
        super().__init__(
            f"all {capacity} patches of sheet {sheet} are used. "
            f"Put a fresh sheet in, then run the same command with --sheet {sheet + 1}."
        )


class NotAccepted(Exception):
    """What was taught contradicts itself or cannot be used; `way_out` says what to do. Nothing was written or moved."""

    exit_code: ClassVar[int] = 4

    def __init__(self, what: str, way_out: str) -> None:
        super().__init__(f"{what} {way_out}")


class StrokesLeftOut(Exception):
    """A collection is finished, but without some of its strokes, which failed every time."""

    exit_code: ClassVar[int] = 3

    def __init__(self, count: int) -> None:
        super().__init__(f"finished; {count} strokes failed every time and were left out")


class CollectAborted(Exception):
    """The run stopped before its end; the same command resumes it."""

    exit_code: ClassVar[int] = 4


def arm_at_fault(error: BaseException) -> bool:
    """Whether the arm failed, or the brush met something hard: then the arm must not move before a person has looked.

    After a line that was refused for a limit, or a press that another client disturbed, the arm may still be lifted.
    """
    lifted = LimitExceeded | PathDisturbed
    robots = isinstance(error, DeviceError) and error.device == "robot" and not isinstance(error, lifted)
    return robots or isinstance(error, ForceTooHigh)


def rest_is_unknown(error: BaseException | None) -> bool:
    """Whether it is not known that the arm rests after this error: the connection was lost, or it did not answer the
    stop."""
    if isinstance(error, ArmMoved):
        return error.moving
    if isinstance(error, PathDisturbed):
        return hasattr(error, "__notes__")  # the stop failed, or the lift after it
    known = RobotNotSafe | NotPowered | LimitExceeded | MotionRefused | NotConnected | SettingsChanged
    return isinstance(error, DeviceError) and error.device == "robot" and not isinstance(error, known)


def describe(error: BaseException) -> str:
    """The message of an error with its notes: one of them may say that the arm still moves."""
    message, notes = str(error) or type(error).__name__, getattr(error, "__notes__", [])
    return " ".join([f"{message.removesuffix('.')}.", *notes]) if notes else message
