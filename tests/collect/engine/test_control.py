"""The transition table and the recovery policy, read as tables; and what an operator asks of a run by key: requests,
and a guided set-up."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest

from brushloop.collect.engine.control import FINAL, TRANSITIONS, RunControl, State
from brushloop.collect.engine.policy import MAX_FAILURES, Action, decide
from brushloop.collect.engine.run import Run
from brushloop.collect.engine.snapshot import Mark
from brushloop.collect.errors import CollectAborted, ForceTooHigh, NeedsOperator, SheetFull, StepVoid, arm_at_fault
from brushloop.collect.operator import Asker, Choice, OperatorRequest, Prompt
from brushloop.collect.protocols.steps import CaptureStep, PressStep, Step, ZeroTouchStep
from brushloop.drivers.errors import DeviceError, DeviceTimeout, LimitExceeded, MotionFailed, RobotNotSafe, Stuck
from brushloop.sessions.events import BoardResult, Condition, Press, StepResult, ZeroTouchResult
from brushloop.sessions.recording import Recording, mark_bad_or_good
from tests.rigs import Lab
from tests.runs import answer, ended_by, question, until, wait_for_end
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
    with pytest.raises(RuntimeError, match="idle -> done"):  # a transition that the table does not have is a defect
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


async def test_what_comes_as_the_run_goes_on_or_the_screen_goes_away_is_not_lost() -> None:
    control = RunControl()
    control.move_to(State.RECOVERING)
    control._lock = SlippedIn(control.pause)  # type: ignore[assignment]
    control.move_to(State.RUNNING)
    assert control.state is State.PAUSING
    asker = Asker(watched=True)
    asker._lock = SlippedIn(asker.abandon)  # type: ignore[assignment]
    async with asyncio.timeout(PATIENCE_S):
        with pytest.raises(NeedsOperator):  # instead of waiting for an answer
            await asker.ask(Prompt("Is the sheet in?", (Choice("g", "yes"),), "g"))


MADE = Press(stroke_id="first", condition=Condition(depth_mm=13.0, tilt_deg=5.0))
PRESS, CAPTURE = PressStep(0, MADE), CaptureStep(0, MADE)
LATE_CAMERA = DeviceTimeout("camera", "fresh", "no new frame")


@pytest.mark.parametrize(
    ("step", "error", "failures", "action", "looked_at_first"),
    [
        (PRESS, StepVoid("rests too high"), 1, Action.RETRY, False),
        (PRESS, StepVoid("rests too high"), MAX_FAILURES, Action.ASK, False),
        (PRESS, MotionFailed("robot", "moveLine", "out of reach"), 1, Action.ABORT, True),
        (PRESS, RobotNotSafe("robot", "moveLine", "safety mode is ProtectiveStop"), 1, Action.ASK, True),
        (PRESS, LimitExceeded("robot", "tilt on the way", 16.0, 0.0, 15.0, "deg"), 1, Action.ABORT, False),
        (PRESS, Stuck("force", 120.0, 24), 1, Action.ASK, False),
        (PRESS, ForceTooHigh(6.0, 5.0), 1, Action.ASK, True),
        (PRESS, SheetFull(42, 1), 1, Action.ASK, False),
        (PRESS, LATE_CAMERA, 1, Action.ABORT, False),
        (CAPTURE, LATE_CAMERA, 1, Action.RETRY, False),
        (CAPTURE, LATE_CAMERA, MAX_FAILURES, Action.ASK, False),
        (CAPTURE, DeviceTimeout("robot", "getTcpPose", "no reply"), 1, Action.ABORT, True),
    ],
)
def test_motion_is_never_blindly_repeated_and_an_arm_at_fault_not_lifted_before_a_person_has_looked(
    step: Step, error: StepVoid | DeviceError, failures: int, action: Action, looked_at_first: bool
) -> None:
    assert decide(step, error, failures) is action
    assert arm_at_fault(error) is looked_at_first


# What an operator asks of a run


def test_a_request_made_twice_is_withdrawn_and_retake_and_skip_exclude_each_other() -> None:
    control = RunControl()
    control.toggle(OperatorRequest.RETAKE)
    control.toggle(OperatorRequest.SKIP)
    assert control.requests == (OperatorRequest.SKIP,)
    control.toggle(OperatorRequest.SKIP)
    assert not control.take(OperatorRequest.SKIP)
    control.toggle(OperatorRequest.JOG)
    assert control.take(OperatorRequest.JOG)
    assert control.requests == ()


def test_the_operator_asks_for_a_new_sheet_and_for_another_take_of_the_first_stroke_on_it(lab: Lab) -> None:
    lab.write_protocol("[11.0]")
    engine = lab.engine(on_screen=True)
    engine.control.toggle(OperatorRequest.RETAKE)
    engine.control.toggle(OperatorRequest.NEW_SHEET)
    engine.start()
    answer(engine, "Replace sheet 1 by a blank one", "g")
    wait_for_end(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.given_up, now.requests) == (State.DONE, 1, 0, ())
    assert now.sheet is not None
    assert now.sheet.number == 2
    assert [mark for mark in now.sheet.marks if mark] == [Mark.BAD, Mark.KEPT]
    assert now.grid[0].bad == 1
    assert len(list(Recording(lab.session).captures())) == 1


def test_what_is_left_out_stays_so_and_what_is_marked_bad_is_pressed_again_at_the_end_exactly_once(lab: Lab) -> None:
    lab.write_protocol("[11.0, 13.0, 15.0]", "[0.0]")
    first = lab.engine(on_screen=True)
    first.control.toggle(OperatorRequest.SKIP)
    first.start()
    last = until(first, lambda now: now.strokes_done == 1 and now.last is not None).last
    assert last is not None
    assert first.snapshot().given_up == 1, "the first stroke was left out before it was pressed"
    folder = lab.session
    # bad, good after all, and bad again: the last word counts
    assert [mark_bad_or_good(folder, last.still, last.press.stroke_id, n) for n in range(3)] == [True, False, True]
    until(first, lambda now: any(cell.now and cell.bad for cell in now.grid))
    first.park()
    ended_by(first, CollectAborted, "parked")
    again = lab.run()

    now = again.snapshot()
    assert (now.state, now.strokes_done, now.strokes_planned, now.given_up) == (State.DONE, 2, 3, 1)
    assert [(cell.bad, cell.left_out) for cell in now.grid].count((0, 0)) == 1
    assert len(lab.rig.world.presses) == 3 + now.voids
    captures = {capture.stroke.stroke_id: capture.bad for capture in Recording(folder).captures()}
    assert len(captures) == 3
    assert {name for name, bad in captures.items() if bad} == {last.press.stroke_id}
    assert f"{last.press.stroke_id}-again" in captures


def test_the_paper_is_found_again_by_jog_and_a_jog_that_is_given_up_or_not_taken_leaves_it_where_it_was(
    lab: Lab,
) -> None:
    lab.write_protocol("[11.0, 13.0, 15.0]", "[0.0]")
    lab.edit_rig("[paper]", '[touch]\nmethod = "jog"\ntouches = 1\n\n[paper]')
    engine = lab.engine(on_screen=True)
    engine.control.toggle(OperatorRequest.JOG)
    engine.start()
    answer(engine, "Touch 1 of 1.", "x")
    answer(engine, "the operator gave up at touch 1 of 1", "g")  # the set-up cannot do without
    answer(engine, "+2.00 mm", "1")
    answer(engine, "+1.00 mm", "1")
    answer(engine, "+0.00 mm", "t")
    answer(engine, "+2.00 mm", "1")  # as it was requested
    answer(engine, "+1.00 mm", "t")
    answer(engine, "paper +1.", "g")
    engine.control.toggle(OperatorRequest.JOG)
    answer(engine, "Touch 1 of 1.", "t")
    answer(engine, "paper +1.", "k")
    engine.control.toggle(OperatorRequest.JOG)
    answer(engine, "Touch 1 of 1.", "x")
    wait_for_end(engine)
    now = engine.snapshot()
    assert now.strokes_done == 3
    assert any("lies +1." in line for line in now.messages)
    assert [result.method for result in lab.state.results(ZeroTouchResult)] == ["jog", "jog"]
    voids = [why for _, why in lab.state.cut]
    assert voids[-2:] == ["the new height was not accepted.", "the operator gave up at touch 1 of 1"]


def test_a_jog_between_strokes_that_fails_leaves_the_paper_where_it_was(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    perform, errors = Run.perform, [DeviceTimeout("force", "latest", "no sample"), ForceTooHigh(6.0, 5.0)]

    async def performed(self: Run, step: Step) -> StepResult:
        if isinstance(step, ZeroTouchStep) and step.index > 0:
            raise errors.pop()
        return await perform(self, step)

    monkeypatch.setattr(Run, "perform", performed)
    engine = lab.engine(on_screen=True)
    engine.control.toggle(OperatorRequest.JOG)
    engine.start()
    answer(engine, "the force reached 6.00 N", "g")  # looked at before the arm moves
    engine.control.toggle(OperatorRequest.JOG)
    wait_for_end(engine)
    assert (engine.snapshot().strokes_done, errors) == (2, [])
    assert [result.method for result in lab.state.results(ZeroTouchResult)] == ["taught"]


def test_a_guided_set_up_measures_again_when_it_is_asked_to_and_later_views_of_the_board_are_not_asked_about(
    lab: Lab,
) -> None:
    with (lab.folder / "protocol.toml").open("a") as protocol:
        protocol.write("board_every = 1\n")
    engine = lab.started(on_screen=True, guided=True)
    answer(engine, "Camera, board, scale", "a")
    asked = question(engine, after=1).question
    for words in ("all within limits", "corners found", "scale (pix2len)", "✓ residual of corners"):
        assert words in asked
    picture = until(engine, lambda now: now.picture is not None).picture
    assert picture is not None
    assert picture.image.shape == (240, 320)
    answer(engine, "Camera, board, scale", "g")
    answer(engine, "Zero touch and plane", "g")
    wait_for_end(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done) == (State.DONE, 2)
    assert len(lab.state.results(BoardResult)) == 3
    assert now.last is not None
    assert now.last.binary is not None
    assert now.last.binary.shape == (128, 128)
    assert now.target_mm is not None
    assert now.trace_n
