"""Carries out a protocol from the first retreat to the last stroke: each step is an attempt that ends done or void, and
the policy says what follows one that failed.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Generator
from dataclasses import dataclass, field, replace

from brushloop.collect.engine import brush, capture
from brushloop.collect.engine.control import State
from brushloop.collect.engine.policy import GO_ON, METHODS, STOP, TITLES, Action, accept_question, decide, question
from brushloop.collect.engine.recorder import ForceGuard, Recorder, RunContext, StepContext, uninterrupted
from brushloop.collect.errors import CollectAborted, NeedsOperator, SheetFull, StepError, arm_at_fault, describe
from brushloop.collect.operator import Choice, OperatorRequest, Prompt
from brushloop.collect.protocols import steps
from brushloop.collect.protocols.steps import MARKING, Protocol, Step, press_of, takes
from brushloop.collect.rig.paper import Patch
from brushloop.collect.walk import patches_of
from brushloop.drivers.errors import ArmMoved, DeviceError, LimitExceeded, MotionError
from brushloop.sessions.errors import SessionError
from brushloop.sessions.events import DipResult, ReviewResult, StepKind, StepResult
from brushloop.sessions.store import Attempt, step_message

KEEP_SHEET = Choice("o", "keep the old sheet")
HEIGHTS = MARKING | {StepKind.ZERO_TOUCH}
"""Steps whose heights count only if the tool is still the one that was set, and the poses came in time."""


@dataclass(slots=True)
class Run(RunContext):
    """One run of a protocol in one process."""

    done: set[str] = field(default_factory=set[str])
    """Keys of the steps that this process has done."""
    enabled: bool = False
    """Whether this run has set power and tool of the arm, and no person has handled the arm since."""

    async def carry_out(self) -> None:
        """Power on, retreat, do every step that is not in the journal yet, repeat what was marked bad, park."""
        await self._retreat()
        if self.opening.request.guided:
            await self._result(steps.BoardStep(0))  # so that the board is seen before the brush comes down
        await self._walk(self.opening.protocol.steps(self_check=bool(self.rig.config.self_check.enabled)))
        for number in itertools.count():
            step = steps.ReviewStep(number)
            if step.key not in self.store.state.done and not capture.marked_bad(self):
                break
            reviewed = await self._result(step)
            assert isinstance(reviewed, ReviewResult)
            for again in reviewed.again:
                await self._walk(takes(self.progress.planned(again.index)))
        await self._retreat()  # the arm may have left for a dip that does not follow

    async def _walk(self, protocol: Protocol) -> None:
        step = next(protocol)
        with contextlib.suppress(StopIteration):
            while True:
                step = protocol.send(await self._result(step))

    async def _retreat(self) -> None:
        """Lift and park between steps. If the arm is stopped, was moved by another client or is outside the limits, ask
        a watching person to release it, and try again."""
        while True:
            try:
                return await self._recover()
            except (MotionError, LimitExceeded) as error:
                await self._ask(error)

    async def _result(self, step: Step) -> StepResult:
        """Return the result of a step: from the journal if it is done, else by doing it until it succeeds."""
        known = self.store.state.done.get(step.key)
        if known is not None and (not step.run_scoped or step.key in self.done):
            return known.result
        failures, asked = 0, self.opening.request.guided and step.kind in TITLES and step.index == 0
        while True:
            await self._between(step)
            try:
                result = await self.perform(step)
                answer = GO_ON
                if asked:
                    answer = await self.asker.ask_or_default(accept_question(result, self.rig.config))
                if answer == STOP.key:
                    await self._park()
                if answer == GO_ON:
                    self.done.add(step.key)
                    return result
                self.procedures.photographer.forget()
                if isinstance(step, steps.ZeroTouchStep) and answer in METHODS:
                    step = replace(step, method=METHODS[answer])
            except (StepError, DeviceError) as error:
                if isinstance(error, NeedsOperator) and self.control.park_wanted:
                    await self._park()  # a question of this step was left open
                failures += 1
                action = decide(step, error, failures)
                if asked and self.asker.watched:
                    action = Action.ASK  # the person at the set-up can remove the cause
                self.progress.log(f"{step.kind}: {error} -> {action}", warning=True)
                if action is not Action.RETRY:
                    parked = await self._lift(error)  # a person may be about to reach under the arm
                    if action is Action.ABORT:
                        raise
                    await self._ask(error, parked=parked)
                    failures = 0
                await self._retreat()
            except SessionError as error:
                await self._lift(error)  # the disk is at fault, the arm is in order
                raise

    async def _between(self, step: Step) -> None:
        """Before each step: park or pause if asked to, and check that the arm is where it was left; before a stroke,
        change the sheet or find the paper again if asked to."""
        if self.control.park_wanted:
            await self._park()
        if self.control.state is State.PAUSING:
            self.progress.doing("paused")
        await self.control.pause_point()
        try:
            await self.rig.robot.confirm()
        except MotionError:
            await self._retreat()  # somebody moved the arm during a pause or a question, or with another client
        if isinstance(step, steps.DipStep) and self.control.take(OperatorRequest.NEW_SHEET):
            await self._new_sheet()
        if isinstance(step, steps.DipStep) and self.control.take(OperatorRequest.JOG):
            await self._touch_again(step)
        if self.control.park_wanted:
            await self._park()

    async def _park(self) -> None:
        await self._retreat()
        raise CollectAborted("parked on request; the session can be resumed with the same command")

    async def _new_sheet(self) -> None:
        sheet = self.store.state.sheet
        text = f"Replace sheet {sheet + 1} by a blank one, then go on."
        choices = (Choice(GO_ON, f"the blank sheet is in place and becomes sheet {sheet + 2}"), KEEP_SHEET)
        await self._retreat()
        if await self.asker.ask_or_default(Prompt(text, choices, KEEP_SHEET.key)) == GO_ON:
            self.fresh_sheet()
        await self._retreat()

    async def _touch_again(self, step: Step) -> None:
        """Zero touch by jog between two strokes; if it fails, the plane stays as it was."""
        touch = steps.ZeroTouchStep(step.index + 1, method="jog")
        try:
            await self.perform(touch)
        except (StepError, DeviceError) as error:
            self.progress.log(f"the previous height of the paper is kept: zero touch by jog: {error}", warning=True)
            if arm_at_fault(error):
                await self._ask(error)
        await self._retreat()

    async def _ask(self, error: StepError | DeviceError, *, parked: bool = False) -> None:
        """Let a person decide after `error`; raise an error if nobody watches or the answer is to stop."""
        if not self.asker.watched:
            raise error
        asked = question(error, self.store.state.sheet)
        answer = await self.asker.ask_or_default(asked)
        meant = next(choice.label for choice in asked.choices if choice.key == answer)
        self.progress.log(f"{asked.question} -> {meant}")
        if answer == STOP.key:
            if parked:
                raise CollectAborted(f"stopped at a question, with the arm parked: {describe(error)}") from error
            raise error
        self.procedures.photographer.forget()  # a person may have changed what the camera sees
        if isinstance(error, MotionError | LimitExceeded):
            self.enabled = False
        if isinstance(error, SheetFull):
            self.fresh_sheet()

    async def _lift(self, error: StepError | DeviceError | SessionError) -> bool:
        """Lift the brush off the paper after `error` and park, unless the arm is at fault; whether that was done."""
        if arm_at_fault(error):
            return False
        try:
            await self._recover()
        except (StepError, DeviceError) as failure:
            error.add_note(f"The brush could not be lifted: {describe(failure)}")
            return False
        return True

    async def _recover(self) -> None:
        if not self.enabled:
            self.progress.doing("power on")
            await self.rig.robot.enable()
            self.enabled = True
        self.control.move_to(State.RECOVERING)
        self.progress.doing("retreat")
        try:
            await self.rig.robot.confirm()
        except ArmMoved as moved:
            self.progress.log(describe(moved), warning=True)  # logged before the arm moves
        self.left_ink_ns = None
        await self.procedures.retreat()
        self.control.move_to(State.RUNNING)

    async def perform(self, step: Step) -> StepResult:
        """Do the step once. If it is cut short, the attempt is void and its patch stays used.

        Raises `SheetFull` before anything is begun.
        """
        store, press = self.store, press_of(step)
        self.progress.doing(step.kind.replace("_", " ") if press is None else f"{step.kind} {press.stroke_id}")
        used, sheet = self.used_patches(), store.state.sheet + 1
        if isinstance(step, steps.DipStep):
            self.sheet.free(used, sheet)  # a brush full of ink does not wait for a fresh sheet
        patches = patches_of(step, self.sheet, used, sheet)
        attempt = store.begin(step.key, step.kind, patches=tuple(patch.index for patch in patches), press=press)
        self.progress.count(store.state)
        try:
            with self._observed(attempt, patches) as context:
                result = await self._do(step, context)
                await self._check_heights(step)
        except BaseException as error:
            self.left_ink_ns = None
            why = "stopped by the operator" if isinstance(error, asyncio.CancelledError) else describe(error)
            await uninterrupted(store.void, attempt, why)
            self.progress.count(store.state)
            raise
        if not isinstance(result, DipResult):
            self.left_ink_ns = None
        elif self.control.take(OperatorRequest.SKIP):
            left_out = self.progress.planned(step.index).press()
            result = result.model_copy(update={"skipped": left_out})
            self.progress.log(f"{left_out.stroke_id}: is left out, as the operator requested")
        await uninterrupted(store.done, attempt, result)
        self.progress.count(store.state)
        return result

    @contextlib.contextmanager
    def _observed(self, attempt: Attempt, patches: tuple[Patch, ...]) -> Generator[StepContext]:
        """Within the block, record the poses and forces of an attempt, and show them to whoever watches."""
        rig, recorder = self.rig, Recorder(attempt.writer, self.rig.clock, self.opening.live)
        recorder.show(step_message(attempt.begin))
        guard = ForceGuard(rig, recorder.force, self.progress.force)
        try:
            rig.robot.listen(recorder.pose)
            if rig.force is not None:
                rig.force.listen(guard.sample)
            yield StepContext(self, patches, attempt, recorder, guard)
        finally:
            if rig.force is not None:
                rig.force.listen(None)
            rig.robot.listen(None)

    async def _check_heights(self, step: Step) -> None:
        """After a step whose heights count: raise `NeedsOperator` if poses came too late for that, and `DeviceError` if
        the tool is not the one that was set."""
        if step.kind not in HEIGHTS:
            return
        robot, limit_ms = self.rig.robot, self.rig.config.robot.max_pose_lag_ms
        with contextlib.suppress(ArmMoved):  # where the arm is now does not change what was done
            await robot.confirm()
        lag_ms = robot.pose_lag_ms()
        if lag_ms is not None and lag_ms > limit_ms:
            raise NeedsOperator(
                f"poses of the arm arrive {lag_ms:.0f} ms late; robot.max_pose_lag_ms = {limit_ms:g}. If only pushed "
                "poses are late, leave robot.rtde_port out of rig.toml: poses are then polled. Otherwise, check the "
                "network."
            )

    async def _do(self, step: Step, context: StepContext) -> StepResult:
        match step:
            case steps.ZeroTouchStep():
                return await brush.zero_touch(context, step)
            case steps.SelfCheckStep():
                return await brush.check_rig(context)
            case steps.BoardStep():
                return await capture.board(context)
            case steps.DipStep():
                return await brush.dip(context)
            case steps.PressStep():
                return await brush.mark(context, step)
            case steps.CaptureStep():
                return await capture.capture(context, step)
            case steps.ReviewStep():
                return capture.review(self)
