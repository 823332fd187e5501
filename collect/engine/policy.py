"""What follows a failed step: try again, ask a person, or stop the run; and the question that is then asked."""

from __future__ import annotations

from enum import StrEnum

from brushloop.collect.errors import (
    BadPicture,
    ForceTooHigh,
    JogGivenUp,
    NeedsOperator,
    SheetFull,
    StepError,
    StepVoid,
    describe,
)
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.protocols.steps import Step
from brushloop.drivers.errors import (
    ArmMoved,
    DeviceError,
    DeviceTimeout,
    MotionError,
    NotPowered,
    PathDisturbed,
    RobotNotSafe,
    SettingsChanged,
    Stuck,
)
from brushloop.drivers.ink.port import DoseLost, InkRefused
from brushloop.sessions.events import StepKind

MAX_FAILURES = 3
"""Failures of one step after which a person decides: so many are no coincidence."""

STOP = Choice("x", "stop the run")
GO_ON = "g"
KEEP = "k"


class Action(StrEnum):
    """What the engine does next."""

    RETRY = "again"
    """Retreat, then do the step again; a press takes a new patch."""
    ASK = "ask"
    """Let a person decide; if nobody watches, stop the run."""
    ABORT = "stop the run"
    """Leave the session open; the same command resumes from there."""


def decide(step: Step, error: StepError | DeviceError, failures: int) -> Action:
    """Return the action for the `failures`-th failure of `step`. Motion is never blindly repeated."""
    match step.kind, error:
        # Only a person can change paper or ink, mend a sensor, release the arm, or see what lies under the brush.
        case _, SheetFull() | NeedsOperator() | ForceTooHigh() | InkRefused() | DoseLost() | RobotNotSafe() | Stuck():
            return Action.ASK
        # Somebody else had the arm.
        case _, ArmMoved() | SettingsChanged() | NotPowered() | PathDisturbed():
            return Action.ASK
        case StepKind.ZERO_TOUCH, JogGivenUp():
            return Action.ASK
        case StepKind.PRESS | StepKind.DRAW, StepVoid():
            action = Action.RETRY
        case StepKind.PRESS | StepKind.DRAW, DeviceTimeout(device="force"):
            # The arm was stopped because the sensor fell silent; if it still is, the next press fails at once.
            action = Action.RETRY
        case StepKind.PRESS | StepKind.DRAW | StepKind.SELF_CHECK, BadPicture():
            return Action.ASK  # another try would use up another patch
        case _, BadPicture():
            action = Action.RETRY
        case StepKind.CAPTURE | StepKind.BOARD, DeviceTimeout(device="camera"):
            action = Action.RETRY
        case _:
            return Action.ABORT
    return action if failures < MAX_FAILURES else Action.ASK


def resume_question(session_id: str, ended: str, hardware: str) -> Prompt:
    """Ask whether the arm may move for a session that goes on. `ended`: how its last run ended; empty if it was cut
    off. `hardware` names a real arm."""
    before = f"The last run ended so: {ended}" if ended else "The last run was cut off: look where it left the arm."
    text = (
        f"Resume {session_id}? {before}\n{hardware}The arm first lifts the brush slowly and parks; the board and the "
        "paper are found again, and the plan goes on. No stroke is made twice."
    )
    resume = "resume: the arm is at rest, the cell is clear, my hand is at the emergency stop"
    return Prompt(text, (Choice(GO_ON, resume), Choice(STOP.key, "do not resume")), STOP.key)


def question(error: StepError | DeviceError, sheet: int) -> Prompt:
    """The question that `error` leads to, while sheet `sheet` (from 0) is in. The default is always to stop: nothing
    moves without an answer."""
    text = describe(error)
    match error:
        case SheetFull():
            text = f"Sheet {sheet + 1} is full. Put a fresh one in, then go on."
            go_on = f"sheet {sheet + 2} is in, and blank"
        case InkRefused():
            go_on = "there is ink: dip again"
        case ForceTooHigh():
            go_on = "nothing is under the brush: lift it and go on"
        case ArmMoved() | PathDisturbed():
            go_on = "nobody else uses the arm: lift it and go on"
        case SettingsChanged():
            go_on = "nobody else uses the arm: restore the settings, lift it and go on"
        case JogGivenUp(height=height):
            text += f". {height[0].upper()}{height[1:]} can be kept: H is then counted from there."
            return Prompt(text, (Choice(KEEP, "keep that height, go on"), Choice("a", "jog again"), STOP), STOP.key)
        case NotPowered():
            go_on = "nothing is in the way of the arm: power it, lift it and go on"
        case MotionError():
            go_on = "the arm is released and nothing is in its way: lift it and go on"
        case _:
            go_on = "the cause is removed: try again"
    return Prompt(text, (Choice(GO_ON, go_on), STOP), STOP.key)
