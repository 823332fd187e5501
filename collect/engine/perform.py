"""Does one step: begins an attempt in the session, does it on the rig, and ends it as `done` or `void`."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from brushloop.collect.engine.force_guard import ForceGuard
from brushloop.collect.engine.live import LiveView
from brushloop.collect.engine.recorder import Recorder
from brushloop.collect.engine.steps import capture, dip, press, retake, touch
from brushloop.collect.engine.steps.context import RunContext, StepContext, uninterrupted
from brushloop.collect.engine.telemetry import Telemetry
from brushloop.collect.errors import PosesLate, describe
from brushloop.collect.operator import OperatorRequest
from brushloop.collect.protocols.steps import MARKING, Result, Step, StepKind
from brushloop.collect.touch.selfcheck import partners
from brushloop.drivers.errors import ArmMoved
from brushloop.sessions.records import StepEvent

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
        self._run.memory.left_ink_ns = None
        await self._run.procedures.retreat()

    async def perform(self, step: Step) -> Result:
        """Do the step once. If it is cut short, the attempt is void and its patch stays used.

        Raises `SheetFull` before anything is begun.
        """
        run = self._run
        rig, store, progress = run.rig, run.store, run.progress
        progress.doing(_in_words(step))
        used = run.used_patches()
        marks = step.kind in MARKING
        # Checked before the dip too, so that a brush full of ink does not wait for a fresh sheet.
        free = run.sheet.free(used, store.state.sheet + 1) if marks or step.kind == StepKind.DIP else None
        patch = free if marks else None
        more = partners(run.sheet, patch, used) if patch is not None and step.kind == StepKind.SELF_CHECK else ()
        notes: dict[str, Any] = {"params": dict(step.params)}
        if more:
            notes["more_patches"] = [other.index for other in more]
        attempt = store.begin(step.key, step.kind, patch=patch.index if patch else None, notes=notes)
        force = rig.config.force
        recorder = Recorder(attempt.writer, rig.clock, None if force is None else force.rate_hz, self._show)
        place = None if patch is None else (store.state.sheet, patch.index)
        progress.begun(step, place)
        guard = ForceGuard(rig, recorder.force)
        event = StepEvent(
            key=step.key,
            kind=step.kind,
            index=step.index,
            attempt=attempt.attempt,
            phase="begin",
            params=step.params,
        )
        try:
            recorder.step(event)
            rig.robot.listen(recorder.pose)
            guard.listen()
            try:
                with guard.also(self._telemetry.force) if self._telemetry is not None else contextlib.nullcontext():
                    result = await self._do(StepContext(run, step, patch, more, attempt, recorder, guard))
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
            recorder.step(event.model_copy(update={"phase": "end"}))
        except BaseException as error:
            run.memory.left_ink_ns = None
            progress.cut(place)
            why = "stopped by the operator" if isinstance(error, asyncio.CancelledError) else describe(error)
            await uninterrupted(store.void, attempt, why)
            raise
        if step.kind == StepKind.DIP and run.requests.take(OperatorRequest.SKIP):
            result = {**result, **progress.skipped(step)}
            progress.log(f"{result['stroke_id']}: is left out, as the operator requested")
        await uninterrupted(store.done, attempt, result)
        progress.finished(step, result)
        return result

    async def _do(self, context: StepContext) -> Result:
        match context.step.kind:
            case StepKind.ZERO_TOUCH:
                return await touch.zero_touch(context)
            case StepKind.TOUCH:
                return await touch.touch(context)
            case StepKind.SELF_CHECK:
                return await touch.check_rig(context)
            case StepKind.BOARD:
                return await capture.board(context)
            case StepKind.DIP:
                return await dip.dip(context)
            case StepKind.PRESS:
                return await press.press(context)
            case StepKind.DRAW:
                return await press.draw(context)
            case StepKind.CAPTURE:
                return await capture.capture(context)
            case StepKind.REVIEW:
                return await retake.review(context)


def _in_words(step: Step) -> str:
    match step.kind:
        case StepKind.PRESS | StepKind.DRAW | StepKind.CAPTURE:
            return f"{step.kind} {step.params['stroke_id']}"
        case _:
            return step.kind.replace("_", " ")
