"""Walks a protocol from the first retreat to the last stroke, and does what the policy says when a step fails."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from brushloop.collect.engine.control import RunControl, State
from brushloop.collect.engine.perform import Performer
from brushloop.collect.engine.policy import GO_ON, STOP, Action, decide, question
from brushloop.collect.engine.set_up import by_method, in_set_up
from brushloop.collect.engine.set_up import question as set_up_question
from brushloop.collect.engine.steps.context import RunContext
from brushloop.collect.engine.steps.retake import marked_bad
from brushloop.collect.errors import NeedsOperator, Parked, SheetFull, StepError, arm_at_fault, describe
from brushloop.collect.operator import Choice, OperatorRequest, Prompt
from brushloop.collect.protocols.plan import takes
from brushloop.collect.protocols.steps import DipStep, Protocol, ReviewStep, Step, ZeroTouchStep
from brushloop.drivers.errors import ArmMoved, DeviceError, LimitExceeded, MotionError
from brushloop.sessions.errors import SessionError
from brushloop.sessions.events import ReviewResult, StepResult

KEEP_SHEET = Choice("o", "keep the old sheet")


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a protocol in one process."""

    context: RunContext
    performer: Performer
    control: RunControl
    guided: bool = False
    """A person accepts what each set-up step measured before it counts."""
    done: set[str] = field(default_factory=set[str])
    """Keys of the steps that this process has done."""

    async def protocol(self, protocol: Protocol) -> None:
        """Power on, retreat, do every step that is not in the journal yet, repeat what was marked bad, park."""
        self.context.progress.doing("power on")
        await self._once_arm_is_free(self.context.rig.robot.enable)
        await self._once_arm_is_free(self._recover)
        await self._walk(protocol)
        for number in itertools.count():
            step = ReviewStep(number)
            if step.key not in self.context.store.state.done and not marked_bad(self.context):
                break
            reviewed = await self._result(step)
            assert isinstance(reviewed, ReviewResult)
            for again in reviewed.again:
                await self._walk(takes(self.context.progress.planned(again.index)))
        await self._once_arm_is_free(self._recover)  # the arm may have left for a dip that does not follow

    async def _walk(self, protocol: Protocol) -> None:
        step = next(protocol)
        with contextlib.suppress(StopIteration):
            while True:
                step = protocol.send(await self._result(step))

    async def _once_arm_is_free(self, act: Callable[[], Awaitable[None]], *, released: bool = False) -> None:
        """Run `act` between steps. If the arm is stopped, was moved by another client or is outside the limits, ask a
        watching person to release it, and try again.

        `released`: a person has handled the arm; first set its power and tool again.
        """
        while True:
            try:
                if released:
                    await self.context.rig.robot.enable()
                return await act()
            except (MotionError, LimitExceeded) as error:
                if not self.context.asker.watched:
                    raise
                await self._ask(error)
                released = True

    async def _result(self, step: Step) -> StepResult:
        """Return the result of a step: from the journal if it is done, else by doing it until it succeeds."""
        known = self.context.store.state.done.get(step.key)
        if known is not None and (not step.run_scoped or step.key in self.done):
            return known.result
        failures, asked = 0, self.guided and in_set_up(step)
        while True:
            await self._between(step)
            try:
                result = await self.performer.perform(step)
                answer = await self._ask_about(result) if asked else GO_ON
                if answer == GO_ON:
                    self.done.add(step.key)
                    return result
                self.context.forget_camera()
                step = by_method(step, answer)
            except (StepError, DeviceError) as error:
                if isinstance(error, NeedsOperator) and self.control.park_wanted:
                    await self._park()  # a question of this step was left open
                failures += 1
                action = decide(step, error, failures)
                if asked and self.context.asker.watched:
                    action = Action.ASK  # the person at the set-up can remove the cause
                self.context.progress.log(f"{step.kind}: {error} -> {action}", warning=True)
                if action is Action.ABORT or (action is Action.ASK and not self.context.asker.watched):
                    await self._lift(error)
                    raise
                if action is Action.ASK:
                    step = by_method(step, await self._ask(error))
                    failures = 0
                released = action is Action.ASK and isinstance(error, MotionError)
                await self._once_arm_is_free(self._recover, released=released)
            except SessionError as error:
                await self._lift(error)  # the disk is at fault, the arm is in order
                raise

    async def _between(self, step: Step) -> None:
        """Before each step: park or pause if asked to, and check that the arm is where it was left; before a stroke,
        change the sheet or find the paper again if asked to."""
        if self.control.park_wanted:
            await self._park()
        await self.control.pause_point()
        await self._back_in_control()
        if isinstance(step, DipStep) and self.context.requests.take(OperatorRequest.NEW_SHEET):
            await self._new_sheet()
        if isinstance(step, DipStep) and self.context.requests.take(OperatorRequest.JOG):
            await self._touch_again(step)
        if self.control.park_wanted:
            await self._park()

    async def _back_in_control(self) -> None:
        """Retreat along the tool axis if the arm is not where it was left: somebody may have moved it during a pause
        or a question, or with another client."""
        released = False
        try:
            return await self.context.rig.robot.confirm()
        except ArmMoved:
            pass
        except MotionError as error:
            if not self.context.asker.watched:
                raise
            await self._ask(error)
            released = True
        await self._once_arm_is_free(self._recover, released=released)

    async def _park(self) -> None:
        await self._once_arm_is_free(self._recover)
        raise Parked("parked on request; the same command resumes from here")

    async def _new_sheet(self) -> None:
        sheet = self.context.store.state.sheet
        text = f"Replace sheet {sheet + 1} by a blank one, then go on."
        choices = (Choice(GO_ON, f"the blank sheet lies there: it becomes sheet {sheet + 2}"), KEEP_SHEET)
        await self._once_arm_is_free(self._recover)
        if await self.context.asker.ask_or_default(Prompt(text, choices, KEEP_SHEET.key)) == GO_ON:
            self.context.fresh_sheet()
        await self._once_arm_is_free(self._recover)

    async def _touch_again(self, step: Step) -> None:
        """Zero touch by jog between two strokes; if it fails, the plane stays as it was."""
        touch = ZeroTouchStep(step.index + 1, method="jog", between_strokes=True)
        released = False
        try:
            await self.performer.perform(touch)
        except (StepError, DeviceError) as error:
            self.context.progress.log(
                f"zero touch by jog: {error} The previous height of the paper is kept.", warning=True
            )
            if arm_at_fault(error):
                await self._ask(error)
                released = isinstance(error, MotionError)
        await self._once_arm_is_free(self._recover, released=released)

    async def _ask_about(self, result: StepResult) -> str:
        """Let a person accept what a set-up step measured. Raises `Parked` if the answer is to stop."""
        answer = await self.context.asker.ask_or_default(set_up_question(result, self.context.rig.config))
        if answer == STOP.key:
            await self._park()
        return answer

    async def _ask(self, error: StepError | DeviceError) -> str:
        """Let a person decide after `error`; return the answer, or raise an error if it is to stop."""
        in_order = False
        if not arm_at_fault(error):
            with contextlib.suppress(StepError, DeviceError):
                await self._recover()  # a person is about to reach under the arm
                in_order = True
        asked = question(error, self.context.store.state.sheet)
        answer = await self.context.asker.ask_or_default(asked)
        meant = next(choice.label for choice in asked.choices if choice.key == answer)
        self.context.progress.log(f"{asked.question} -> {meant}")
        if answer == STOP.key:
            if in_order:
                raise Parked(f"stopped at a question, parked: {describe(error)}") from error
            raise error
        self.context.forget_camera()
        if isinstance(error, SheetFull):
            self.context.fresh_sheet()
        return answer

    async def _lift(self, error: StepError | DeviceError | SessionError) -> None:
        """Lift the brush off the paper after `error`, unless the arm is at fault."""
        if arm_at_fault(error):
            return
        try:
            await self._recover()
        except (StepError, DeviceError) as failure:
            error.add_note(f"The brush could not be lifted: {describe(failure)}")

    async def _recover(self) -> None:
        self.control.move_to(State.RECOVERING)
        self.context.progress.doing("retreat")
        try:
            await self.context.rig.robot.confirm()
        except ArmMoved as moved:
            self.context.progress.log(describe(moved), warning=True)  # logged before the arm moves
        await self.performer.retreat()
        self.control.go_on()
