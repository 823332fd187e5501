"""The transition table and the recovery policy, read as tables."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest

from brushloop.collect.engine.control import FINAL, TRANSITIONS, RunControl, State
from brushloop.collect.engine.policy import MAX_FAILURES, Action, decide
from brushloop.collect.errors import ForceTooHigh, NeedsOperator, SheetFull, StepVoid, arm_at_fault
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.protocols.steps import CaptureStep, PressStep, Step
from brushloop.drivers.errors import DeviceError, DeviceTimeout, LimitExceeded, MotionFailed, RobotNotSafe, Stuck
from brushloop.sessions.events import Condition, Press
from tests.waiting import PATIENCE_S


def test_every_state_can_be_reached_and_stopped_from_until_a_final_one_which_nothing_leaves() -> None:
    reached, frontier = {State.IDLE}, [State.IDLE]
    while frontier:
        new = TRANSITIONS[frontier.pop()] - reached
        reached |= new
        frontier += new
    assert reached == set(State)
    assert all(State.STOPPING in TRANSITIONS[state] for state in set(State) - FINAL - {State.STOPPING})
    assert not any(TRANSITIONS[state] for state in FINAL)


def test_a_way_that_the_table_does_not_have_is_a_defect() -> None:
    with pytest.raises(RuntimeError, match="idle -> done"):
        RunControl().end(State.DONE)


class SlippedIn:
    """A lock that another thread gets first, once, to do this."""

    def __init__(self, do: Callable[[], object]) -> None:
        self._lock, self._do = threading.Lock(), [do]

    def __enter__(self) -> None:
        if self._do:
            self._do.pop()()
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def test_a_pause_that_comes_as_the_run_goes_on_is_not_lost() -> None:
    control = RunControl()
    control.move_to(State.RECOVERING)
    control._lock = SlippedIn(control.pause)  # type: ignore[assignment]
    control.move_to(State.RUNNING)
    assert control.state is State.PAUSING


async def test_a_question_that_is_asked_as_the_screen_goes_away_does_not_wait_for_an_answer() -> None:
    asker = Asker(watched=True)
    asker._lock = SlippedIn(asker.abandon)  # type: ignore[assignment]
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(NeedsOperator):
            await asker.ask(Prompt("Is the sheet in?", (Choice("g", "yes"),), "g"))


MADE = Press(stroke_id="first", condition=Condition(depth_mm=13.0, tilt_deg=5.0))
PRESS, CAPTURE = PressStep(0, MADE), CaptureStep(0, MADE)
LATE_CAMERA = DeviceTimeout("camera", "fresh", "no new frame")


@pytest.mark.parametrize(
    ("step", "error", "failures", "action"),
    [
        (PRESS, StepVoid("rests too high"), 1, Action.RETRY),
        (PRESS, StepVoid("rests too high"), MAX_FAILURES, Action.ASK),
        (PRESS, MotionFailed("robot", "moveLine", "out of reach"), 1, Action.ABORT),
        (PRESS, RobotNotSafe("robot", "moveLine", "safety mode is ProtectiveStop"), 1, Action.ASK),
        (PRESS, Stuck("force", 120.0, 24), 1, Action.ASK),
        (PRESS, SheetFull(42, 1), 1, Action.ASK),
        (PRESS, LATE_CAMERA, 1, Action.ABORT),
        (CAPTURE, LATE_CAMERA, 1, Action.RETRY),
        (CAPTURE, LATE_CAMERA, MAX_FAILURES, Action.ASK),
        (CAPTURE, DeviceTimeout("robot", "getTcpPose", "no reply"), 1, Action.ABORT),
    ],
)
def test_motion_is_never_blindly_repeated(
    step: Step, error: StepVoid | DeviceError, failures: int, action: Action
) -> None:
    assert decide(step, error, failures) is action


@pytest.mark.parametrize(
    ("error", "looked_at_first"),
    [
        (MotionFailed("robot", "moveLine", "out of reach"), True),
        (DeviceTimeout("robot", "getTcpPose", "no reply"), True),
        (ForceTooHigh(6.0, 5.0), True),
        (LimitExceeded("robot", "tilt on the way", 16.0, 0.0, 15.0, "deg"), False),
        (LATE_CAMERA, False),
        (StepVoid("rests too high"), False),
    ],
)
def test_an_arm_at_fault_is_not_lifted_before_a_person_has_looked(error: Exception, looked_at_first: bool) -> None:
    assert arm_at_fault(error) is looked_at_first
