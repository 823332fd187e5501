"""What follows a failed step. A plain function of step, error and count, so that it reads as a table."""

from __future__ import annotations

from enum import StrEnum

from collect.errors import BadPicture, ForceTooHigh, JogGivenUp, NeedsOperator, SheetFull, StepError, StepVoid
from collect.protocols.steps import Step, StepKind
from drivers.errors import ArmMoved, DeviceError, DeviceTimeout, RobotNotSafe, SettingsChanged, Stuck
from drivers.ink.port import InkRefused

MAX_FAILURES = 3
"""The third failure of one step is not chance: a person decides."""


class Action(StrEnum):
    """What the engine does next."""

    RETRY = "again"
    """Retreat, then do the step again; a press takes a new cell."""
    ASK = "ask"
    """A person decides. Where nobody watches, it means to stop the run."""
    ABORT = "stop the run"
    """The session stays open; the same command goes on from there."""


def decide(step: Step, error: StepError | DeviceError, failures: int) -> Action:
    """The action for the `failures`-th failure of `step`. Motion is never blindly repeated."""
    match step.kind, error:
        # What only a person can put right: paper, ink, a sensor, the arm's own stops, and what lies under the brush.
        case _, SheetFull() | NeedsOperator() | ForceTooHigh() | InkRefused() | RobotNotSafe() | Stuck():
            return Action.ASK
        # Somebody else has had the arm.
        case _, ArmMoved() | SettingsChanged():
            return Action.ASK
        case StepKind.ZERO_TOUCH, JogGivenUp():
            return Action.ASK
        case StepKind.PRESS | StepKind.DRAW, StepVoid():
            action = Action.RETRY
        case StepKind.PRESS | StepKind.DRAW, DeviceTimeout(device="force"):
            # Stopped because nothing was felt any more; if the sensor is not back, the next press says so at once.
            action = Action.RETRY
        case StepKind.PRESS | StepKind.DRAW | StepKind.SELF_CHECK, BadPicture():
            return Action.ASK  # another try would burn another cell
        case _, BadPicture():
            action = Action.RETRY
        case StepKind.CAPTURE | StepKind.BOARD, DeviceTimeout(device="camera"):
            action = Action.RETRY
        case _:
            return Action.ABORT
    return action if failures < MAX_FAILURES else Action.ASK
