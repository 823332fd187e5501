"""Does one step: begins an attempt in the session, does it on the rig, and ends it as `done` or `void`."""

from __future__ import annotations

import asyncio
import contextlib

from brushloop.collect.engine.force_guard import ForceGuard
from brushloop.collect.engine.live import LiveView
from brushloop.collect.engine.recorder import Recorder
from brushloop.collect.engine.steps import capture, dip, press, retake, touch
from brushloop.collect.engine.steps.context import RunContext, StepContext, uninterrupted
from brushloop.collect.engine.telemetry import Telemetry
from brushloop.collect.errors import PosesLate, describe
from brushloop.collect.operator import OperatorRequest
from brushloop.collect.protocols.steps import (
    MARKING,
    BoardStep,
    CaptureStep,
    DipStep,
    DrawStep,
    PressStep,
    ReviewStep,
    SelfCheckStep,
    Step,
    TouchStep,
    ZeroTouchStep,
    press_of,
)
from brushloop.collect.touch.selfcheck import partners
from brushloop.drivers.errors import ArmMoved
from brushloop.sessions.events import DipResult, StepKind, StepResult
from brushloop.sessions.store import step_message

HEIGHTS = MARKING | {StepKind.ZERO_TOUCH, StepKind.TOUCH}
"""Steps whose heights count only if the tool is still the one that was set, and the poses came in time."""


class Performer:
    """Does the steps of one run."""

    def __init__(self, run: RunContext, live: LiveView | None = None, telemetry: Telemetry | None = None) -> None:
        """`live` is shown every message that is recorded; `telemetry` gets every force."""
        self._run = run
        self._show = None if live is None else live.offer
        self._telemetry = telemetry

    async def retreat(self) -> None:
        """Lift the arm and move it away from wherever it is; belongs to no step and is not recorded."""
        self._run.left_ink_ns = None
        await self._run.procedures.retreat()

    async def perform(self, step: Step) -> StepResult:
        """Do the step once. If it is cut short, the attempt is void and its patch stays used.

        Raises `SheetFull` before anything is begun.
        """
        run = self._run
        rig, store, progress = run.rig, run.store, run.progress
        progress.doing(_in_words(step))
        used = run.used_patches()
        marks = step.kind in MARKING
        # Checked before the dip too, so that a brush full of ink does not wait for a fresh sheet.
        free = run.sheet.free(used, store.state.sheet + 1) if marks or isinstance(step, DipStep) else None
        patch = free if marks else None
        more = partners(run.sheet, patch, used) if patch is not None and isinstance(step, SelfCheckStep) else ()
        marked = () if patch is None else (patch.index, *(other.index for other in more))
        attempt = store.begin(step.key, step.kind, patches=marked, press=press_of(step))
        force = rig.config.force
        recorder = Recorder(attempt.writer, rig.clock, None if force is None else force.rate_hz, self._show)
        if self._show is not None:
            self._show(step_message(attempt.begin))
        progress.begun(step)
        guard = ForceGuard(rig, recorder.force)
        try:
            rig.robot.listen(recorder.pose)
            guard.listen()
            try:
                with guard.also(self._telemetry.force) if self._telemetry is not None else contextlib.nullcontext():
                    result = await self._do(step, StepContext(run, patch, more, attempt, recorder, guard))
                if step.kind in HEIGHTS:
                    with contextlib.suppress(ArmMoved):  # where the arm is now does not change what was done
                        await rig.robot.confirm()
                lag_ms = rig.robot.pose_lag_ms()
                if step.kind in HEIGHTS and lag_ms is not None and lag_ms > rig.config.robot.max_pose_lag_ms:
                    raise PosesLate(lag_ms, rig.config.robot.max_pose_lag_ms)
            finally:
                guard.deafen()
                rig.robot.listen(None)
            recorder.cadence(lag_ms)
        except BaseException as error:
            run.left_ink_ns = None
            why = "stopped by the operator" if isinstance(error, asyncio.CancelledError) else describe(error)
            await uninterrupted(store.void, attempt, why)
            progress.finished()
            raise
        if isinstance(result, DipResult) and run.requests.take(OperatorRequest.SKIP):
            left_out = progress.planned(step.index).press()
            result = result.model_copy(update={"skipped": left_out})
            progress.log(f"{left_out.stroke_id}: is left out, as the operator requested")
        await uninterrupted(store.done, attempt, result)
        progress.finished()
        return result

    async def _do(self, step: Step, context: StepContext) -> StepResult:
        match step:
            case ZeroTouchStep():
                return await touch.zero_touch(context, step)
            case TouchStep():
                return await touch.touch(context, step)
            case SelfCheckStep():
                return await touch.check_rig(context)
            case BoardStep():
                return await capture.board(context)
            case DipStep():
                return await dip.dip(context)
            case PressStep():
                return await press.press(context, step)
            case DrawStep():
                return await press.draw(context, step)
            case CaptureStep():
                return await capture.capture(context, step)
            case ReviewStep():
                return await retake.review(context.run)


def _in_words(step: Step) -> str:
    made = press_of(step)
    return step.kind.replace("_", " ") if made is None else f"{step.kind} {made.stroke_id}"
