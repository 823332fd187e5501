"""Does steps: begins an attempt in the session, does it on the rig, and ends it as either `done` or `void`."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from collect.engine.force_guard import ForceGuard
from collect.engine.inking import Inking
from collect.engine.live import LiveView
from collect.engine.progress import Progress
from collect.engine.recorder import Recorder
from collect.engine.steps import capture as capturing
from collect.engine.steps import choose as choosing
from collect.engine.steps import dip as dipping
from collect.engine.steps import look as looking
from collect.engine.steps import press as marking
from collect.engine.steps import review as reviewed
from collect.engine.steps import touch as touching
from collect.engine.steps.context import RunContext, StepContext
from collect.engine.steps.waiting import uninterrupted
from collect.engine.telemetry import Telemetry
from collect.errors import SheetFull, StepError, describe
from collect.motion.procedures import Procedures
from collect.operator import Asker, OperatorRequest, OperatorRequests
from collect.protocols.config import ProtocolConfig, WriteConfig
from collect.protocols.plans import cell_mm
from collect.protocols.steps import MARKING, Result, Step, StepKind
from collect.rig.devices import Rig
from collect.rig.paper import Sheet
from collect.touch.selfcheck import partners
from drivers.errors import ArmMoved, DeviceError
from sessions.recording.schemas import StepEvent
from sessions.store import SessionStore

HEIGHTS = MARKING | {StepKind.ZERO_TOUCH, StepKind.TOUCH}
"""Steps that count only if the tool is still the one that was set: their heights would be false."""


class Performer:
    """Steps of one protocol on one rig into one session."""

    def __init__(
        self,
        rig: Rig,
        store: SessionStore,
        protocol: ProtocolConfig,
        progress: Progress,
        asker: Asker,
        live: LiveView | None = None,
        *,
        telemetry: Telemetry | None = None,
        requests: OperatorRequests | None = None,
    ) -> None:
        """`telemetry` is handed every force; `requests` are what an operator asks for by key."""
        self._show = None if live is None else live.offer
        self._run_context = RunContext(
            rig,
            store,
            progress,
            asker,
            Procedures(rig),
            Inking(rig),
            Sheet(rig.config.paper, cell_mm(protocol)),
            protocol,
            requests=requests or OperatorRequests(),
        )
        self._telemetry = telemetry

    async def retreat(self) -> None:
        """Bring the arm up and away from wherever it is; belongs to no step and is not recorded."""
        self._run_context.known.left_ink_ns = None
        await self._run_context.procedures.retreat()

    def answered(self, error: StepError | DeviceError) -> None:
        """A person has put right what `error` said: a full sheet was changed, or something at the camera."""
        self.forget_camera()
        if isinstance(error, SheetFull):
            self.fresh_sheet()

    def forget_camera(self) -> None:
        """A person may have changed something at the camera or in its view: measure its delay again."""
        self._run_context.procedures.photographer.forget()

    def fresh_sheet(self) -> None:
        """A person has put a fresh sheet in."""
        self._run_context.store.fresh_sheet()
        self._run_context.known.sound_frame = None
        self.forget_camera()
        self._run_context.progress.sheet_in(self._run_context.store.state.sheet)

    @property
    def write(self) -> WriteConfig | None:
        """How figures are drawn, where the protocol draws some."""
        protocol = self._run_context.protocol
        return protocol if isinstance(protocol, WriteConfig) else None

    @property
    def marked_bad(self) -> bool:
        """Whether a person has marked a capture bad that was not made again yet."""
        return bool(reviewed.marked_bad(self._run_context))

    async def perform(self, step: Step) -> Result:
        """Do the step once. If it is cut, the attempt is voided and its cell stays used. Raises `SheetFull` first."""
        run = self._run_context
        rig, store, progress = run.rig, run.store, run.progress
        progress.doing(_in_words(step))
        used = run.used_cells()
        marks = step.kind in MARKING
        # Before the dip as well: a brush full of ink does not wait for a fresh sheet.
        free = run.sheet.free(used, store.state.sheet + 1) if marks or step.kind == StepKind.DIP else None
        cell = free if marks else None
        more = partners(run.sheet, cell, used) if cell is not None and step.kind == StepKind.SELF_CHECK else ()
        notes: dict[str, Any] = {"params": dict(step.params)}
        if more:
            notes["more_cells"] = [other.index for other in more]
        attempt = store.begin(step.key, step.kind, cell=cell.index if cell else None, notes=notes)
        force = rig.config.force
        recorder = Recorder(attempt.writer, rig.clock, None if force is None else force.rate_hz, self._show)
        place = None if cell is None else (store.state.sheet, cell.index)
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
                    result = await self._do(StepContext(run, step, cell, more, attempt, recorder, guard))
                if step.kind in HEIGHTS:
                    with contextlib.suppress(ArmMoved):  # where it is now does not matter to what was done
                        await rig.robot.confirm()
            finally:
                guard.deafen()
                rig.robot.listen(None)
            recorder.cadence()
            recorder.step(event.model_copy(update={"phase": "end"}))
        except BaseException as error:
            run.known.left_ink_ns = None
            progress.cut(place)
            why = "stopped by the operator" if isinstance(error, asyncio.CancelledError) else describe(error)
            await uninterrupted(store.void, attempt, why)
            raise
        if step.kind == StepKind.DIP and run.requests.take(OperatorRequest.SKIP):
            result = {**result, **progress.skipped(step)}
            progress.log(f"{result['stroke_id']}: is left out, as the operator asked")
        await uninterrupted(store.done, attempt, result)
        progress.finished(step, result)
        if step.kind == StepKind.CAPTURE:
            progress.captured(result)
        return result

    async def _do(self, context: StepContext) -> Result:
        match context.step.kind:
            case StepKind.ZERO_TOUCH:
                return await touching.zero_touch(context)
            case StepKind.TOUCH:
                return await touching.touch(context)
            case StepKind.SELF_CHECK:
                return await touching.check_rig(context)
            case StepKind.BOARD:
                return await looking.board(context)
            case StepKind.DIP:
                return await dipping.dip(context)
            case StepKind.PRESS:
                return await marking.press(context)
            case StepKind.DRAW:
                return await marking.draw(context)
            case StepKind.CAPTURE:
                return await capturing.capture(context)
            case StepKind.CHOOSE:
                return await choosing.choose(context)
            case StepKind.REVIEW:
                return await reviewed.review(context)


def _in_words(step: Step) -> str:
    match step.kind:
        case StepKind.PRESS | StepKind.DRAW | StepKind.CAPTURE:
            return f"{step.kind} {step.params['stroke_id']}"
        case StepKind.DIP:
            return "dip"
        case _:
            return step.kind.replace("_", " ")
