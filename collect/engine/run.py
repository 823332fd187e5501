"""One session from the first retreat to the last stroke: walks the protocol, and does what the policy says."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Protocol as Interface

from collect.engine.perform import Performer
from collect.engine.policy import Action, decide
from collect.engine.progress import Progress
from collect.engine.questions import GO_ON, STOP, question
from collect.engine.set_up import again
from collect.engine.set_up import question as set_up_question
from collect.engine.set_up_steps import SET_UP
from collect.engine.states import State
from collect.errors import ForceTooHigh, Parked, StepError, describe
from collect.operator import Asker, Choice, OperatorRequest, OperatorRequests, Prompt
from collect.protocols.steps import Protocol, Result, Step, StepKind
from collect.protocols.strokes import takes
from collect.rig.devices import Rig
from drivers.errors import ArmMoved, DeviceError, LimitExceeded, MotionError, RpcError
from sessions.errors import SessionError
from sessions.store import SessionStore


class Control(Interface):
    """What a run needs of the engine around it: its state, and the pause and stop keys."""

    def move_to(self, new: State) -> None:
        """Change the state. Raises `CancelledError` where the stop key was faster."""
        ...

    def running(self) -> State:
        """The state to go on in: running, or pausing where that was asked for."""
        ...

    async def pause_point(self) -> None:
        """Between two steps: wait here while paused."""
        ...

    @property
    def park_wanted(self) -> bool:
        """Whether the run is to end before the next step."""
        ...


ITS_OWN_TROUBLE = (MotionError, RpcError, ForceTooHigh)
"""After these the arm is not moved before a person has looked."""
KEEP_SHEET = Choice("o", "keep the old one in")


@dataclass(frozen=True, slots=True)
class Run:
    """Everything that one session in one process works with."""

    rig: Rig
    store: SessionStore
    performer: Performer
    progress: Progress
    asker: Asker
    control: Control
    requests: OperatorRequests
    guided: bool = False
    """A person looks at what each set-up step measured before it counts."""

    async def protocol(self, protocol: Protocol) -> None:
        """Power on, retreat, then every step that the journal does not hold yet, then what was marked bad again."""
        self.progress.doing("power on")
        await self._willing(self.rig.robot.enable)
        await self._willing(self._recover)
        await self._walk(protocol)
        for number in itertools.count():
            step = Step(StepKind.REVIEW, number)
            if step.key not in self.store.state.done and not self.performer.marked_bad:
                break
            for stroke_id, _ in (await self._result(step))["again"]:
                await self._walk(takes(self.progress.made_again(str(stroke_id)), write=self.performer.write))

    async def _walk(self, protocol: Protocol) -> None:
        step = next(protocol)
        with contextlib.suppress(StopIteration):
            while True:
                step = protocol.send(await self._result(step))

    async def _willing(self, act: Callable[[], Awaitable[None]], *, released: bool = False) -> None:
        """Between steps: an arm that is held, or that somebody else has or left outside the limits, may be put right
        while somebody watches.

        `released`: a person has had the arm. Its power and tool are set anew before anything else.
        """
        while True:
            try:
                if released:
                    await self.rig.robot.enable()
                return await act()
            except (MotionError, LimitExceeded) as error:
                if not self.asker.watched:
                    raise
                await self._ask(error)
                released = True

    async def _result(self, step: Step) -> Result:
        known = self.store.state.done.get(step.key)
        if known is not None and not step.run_scoped:
            return known["result"]
        failures = 0
        while True:
            await self._between(step)
            try:
                result = await self.performer.perform(step)
                if not self.guided or step.kind not in SET_UP:
                    return result
                answer = await self._ask_about(step, result)
                if answer == GO_ON:
                    return result
                self.performer.forget_camera()
                step = again(step, answer)
            except (StepError, DeviceError) as error:
                failures += 1
                action = decide(step, error, failures)
                if self.guided and step.kind in SET_UP and self.asker.watched:
                    action = Action.ASK  # whoever sets up is there to mend it
                self.progress.log(f"{step.kind}: {error} -> {action}", warning=True)
                if action is Action.ABORT or (action is Action.ASK and not self.asker.watched):
                    await self._lift(error)
                    raise
                if action is Action.ASK:
                    step = again(step, await self._ask(error))
                    failures = 0
                released = action is Action.ASK and isinstance(error, MotionError)
                await self._willing(self._recover, released=released)
            except SessionError as error:
                await self._lift(error)  # the disk is at fault, the arm is in order
                raise

    async def _between(self, step: Step) -> None:
        """Before each step: park or pause where that was asked for, and see that the arm is as it was left; before a
        stroke, a new sheet and a new touch."""
        if self.control.park_wanted:
            await self._park()
        await self.control.pause_point()
        if self.control.park_wanted:
            await self._park()
        await self._back_in_control()
        if step.kind is StepKind.DIP and self.requests.take(OperatorRequest.NEW_SHEET):
            await self._new_sheet()
        if step.kind is StepKind.DIP and self.requests.take(OperatorRequest.JOG):
            await self._touch_again(step)

    async def _back_in_control(self) -> None:
        """Somebody else may have had the arm, in a pause, in a question, or with a client of his own: where it is not
        as it was left, it first goes up along its tool axis."""
        released = False
        try:
            return await self.rig.robot.confirm()
        except ArmMoved:
            pass
        except MotionError as error:
            if not self.asker.watched:
                raise
            await self._ask(error)
            released = True
        await self._willing(self._recover, released=released)

    async def _park(self) -> None:
        await self._willing(self._recover)
        raise Parked("parked as was asked; the same command goes on from here")

    async def _new_sheet(self) -> None:
        sheet = self.store.state.sheet
        words = f"Put a new sheet in for sheet {sheet + 1}, then go on."
        choices = (Choice(GO_ON, f"sheet {sheet + 2} is in, and blank"), KEEP_SHEET)
        await self._willing(self._recover)
        self.control.move_to(State.ASKING)
        self.progress.doing("wait for an answer")
        if await self.asker.ask(Prompt(words, choices, KEEP_SHEET.key)) == GO_ON:
            self.performer.fresh_sheet()
        await self._willing(self._recover)

    async def _touch_again(self, step: Step) -> None:
        """Zero touch by jog between two strokes; where it fails, the plane stays as it was."""
        touch = Step(StepKind.ZERO_TOUCH, step.index + 1, {"method": "jog", "between_strokes": True})
        try:
            await self.performer.perform(touch)
        except StepError as error:
            self.progress.log(f"zero touch by jog: {error} The paper stays where it was found before.", warning=True)
        await self._willing(self._recover)

    async def _ask_about(self, step: Step, result: Result) -> str:
        """What a set-up step measured, for a person to accept. Raises `Parked` where the answer is to stop."""
        self.control.move_to(State.ASKING)
        self.progress.doing("wait for an answer")
        answer = await self.asker.ask(set_up_question(step.kind, result, self.rig.config))
        self.control.move_to(self.control.running())
        if answer == STOP.key:
            await self._park()
        return answer

    async def _ask(self, error: StepError | DeviceError) -> str:
        """Let a person decide; returns the answer, and raises `error` again where it is to stop."""
        in_order = False
        if not isinstance(error, ITS_OWN_TROUBLE):
            with contextlib.suppress(StepError, DeviceError):
                await self._recover()  # a person is about to reach under the arm
                in_order = True
        self.control.move_to(State.ASKING)
        self.progress.doing("wait for an answer")
        asked = question(error, self.store.state.sheet)
        answer = await self.asker.ask(asked)
        meant = next(choice.label for choice in asked.choices if choice.key == answer)
        self.progress.log(f"{asked.question} -> {meant}")
        if answer == STOP.key:
            if in_order:
                raise Parked(f"stopped at a question, parked: {describe(error)}") from error
            raise error
        self.performer.answered(error)
        return answer

    async def _lift(self, error: StepError | DeviceError | SessionError) -> None:
        """Leave no brush in the paper, where the arm itself is in order: not after its own trouble, nor where the brush
        met something hard that a person must look at first."""
        if isinstance(error, ITS_OWN_TROUBLE) or getattr(error, "device", "") == "robot":
            return
        try:
            await self._recover()
        except (StepError, DeviceError) as failure:
            error.add_note(f"The brush could not be lifted: {describe(failure)}")

    async def _recover(self) -> None:
        self.control.move_to(State.RECOVERING)
        self.progress.doing("retreat")
        try:
            await self.rig.robot.confirm()
        except ArmMoved as moved:
            self.progress.log(describe(moved), warning=True)  # told before it moves
        await self.performer.retreat()
        self.control.move_to(self.control.running())
