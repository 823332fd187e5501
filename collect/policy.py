"""What follows a failed step. A plain function of step, error and count, so that it reads as a table."""

from __future__ import annotations

from enum import StrEnum

from collect.errors import SheetFull, StepError, StepVoid
from collect.steps import Step, StepKind
from drivers.errors import DeviceError, DeviceTimeout

MAX_FAILURES = 3
"""The third failure of one step ends the run: by then it is not chance."""


class Action(StrEnum):
    """What the engine does next."""

    RETRY = "again"
    """Retreat, then do the step again; a press takes a new cell."""
    ABORT = "stop the run"
    """Retreat is left to the next run; the session stays open. Headless, asking means this."""


def decide(step: Step, error: StepError | DeviceError, failures: int) -> Action:
    """The action for the `failures`-th failure of `step`. Motion is never blindly repeated."""
    if failures >= MAX_FAILURES or isinstance(error, SheetFull):
        return Action.ABORT
    match step.kind, error:
        case StepKind.PRESS, StepVoid():
            return Action.RETRY
        case ((StepKind.CAPTURE | StepKind.BOARD), DeviceTimeout(device="camera")):
            return Action.RETRY
        case _:
            return Action.ABORT
