"""Performs one step: journal, record, move, and either `done` or `void`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from calibrate.errors import CalibrationError
from calibrate.scale import see_board
from collect.errors import StepError, told
from collect.procedures import Procedures
from collect.progress import Progress
from collect.recorder import Recorder
from collect.rig import Rig
from collect.sheet import Cell, Sheet
from collect.steps import Result, Step, StepKind
from sessions.schemas import StepEvent, Stroke
from sessions.store import Attempt, SessionStore

_R = TypeVar("_R")


class Performer:
    """Steps on one rig into one session."""

    def __init__(self, rig: Rig, store: SessionStore, progress: Progress) -> None:
        self._rig = rig
        self._store = store
        self._progress = progress
        self._procedures = Procedures(rig)
        self._sheet = Sheet(rig.config.paper)
        self._inked = False
        """Whether the brush was dipped in this process and has not pressed since."""

    async def retreat(self) -> None:
        """Bring the arm up and away from wherever it is; belongs to no step and is not recorded."""
        self._inked = False
        await self._procedures.retreat()

    async def perform(self, step: Step) -> Result:
        """Do the step once. If it is cut, the attempt is voided and its cell stays used. Raises `SheetFull` first."""
        self._progress.doing(_in_words(step))
        cell = self._free_cell() if step.kind == StepKind.PRESS else None
        attempt = self._store.begin(
            step.key, step.kind, cell=cell.index if cell else None, notes={"params": dict(step.params)}
        )
        recorder = Recorder(attempt.writer, self._rig.clock)
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
            self._rig.robot.listen(recorder.pose)
            try:
                result = await self._do(step, cell, attempt, recorder)
            finally:
                self._rig.robot.listen(None)
            recorder.step(event.model_copy(update={"phase": "end"}))
        except BaseException as error:
            self._inked = False
            self._progress.voided()
            why = "stopped by the operator" if isinstance(error, asyncio.CancelledError) else told(error)
            await uninterrupted(self._store.void, attempt, why)
            raise
        await uninterrupted(self._store.done, attempt, result)
        if step.kind == StepKind.CAPTURE:
            self._progress.captured(result)
        return result

    async def _do(self, step: Step, cell: Cell | None, attempt: Attempt, recorder: Recorder) -> Result:
        match step.kind:
            case StepKind.ZERO_TOUCH:
                return {"touch_z_mm": await self._procedures.zero_touch(), "method": "taught"}
            case StepKind.BOARD:
                return await self._board(attempt, recorder)
            case StepKind.DIP:
                await self._procedures.dip()
                self._inked = True
                return {}
            case StepKind.PRESS:
                assert cell is not None
                return await self._press(step, cell, recorder)
            case StepKind.CAPTURE:
                return await self._capture(step, attempt, recorder)

    async def _board(self, attempt: Attempt, recorder: Recorder) -> Result:
        frame = await self._procedures.capture()
        await uninterrupted(recorder.still, frame, attempt.serial)
        try:
            plane = await uninterrupted(see_board, frame.image, self._rig.config.board)
        except CalibrationError as error:
            # Without it nothing that follows could be measured: better now than after 150 presses.
            raise StepError(f"the board is not seen: {error.what}") from None
        return {"still": attempt.serial, "corners": plane.corners, "mm_per_px": plane.mm_per_px}

    async def _press(self, step: Step, cell: Cell, recorder: Recorder) -> Result:
        if not self._inked:
            # Resumed, or the last press failed: the brush may have dried or lost its ink since its dip.
            recorder.log("dip again before the press")
            await self._procedures.dip()
        self._inked = False
        depth_mm = await self._procedures.press(
            cell,
            _number(step, "height_mm"),
            _number(step, "tilt_deg"),
            _number(step, "dwell_s"),
        )
        return {
            "stroke_id": step.params["stroke_id"],
            "sheet": self._store.state.sheet,
            "cell": cell.index,
            "depth_mm": depth_mm,
        }

    async def _capture(self, step: Step, attempt: Attempt, recorder: Recorder) -> Result:
        if int(_number(step, "sheet")) != self._store.state.sheet:
            raise StepError(f"{step.params['stroke_id']} lies on another sheet than the one that is in")
        frame = await self._procedures.capture()
        await uninterrupted(recorder.still, frame, attempt.serial)
        cell = self._sheet.cell(int(_number(step, "cell")))
        stroke = Stroke(
            stroke_id=str(step.params["stroke_id"]),
            kind="press",
            still=attempt.serial,
            height_mm=_number(step, "height_mm"),
            tilt_deg=_number(step, "tilt_deg"),
            cell_mm=cell.rect_mm,
            anchor_mm=cell.anchor_mm,
        )
        recorder.stroke(stroke)
        return {
            "stroke_id": stroke.stroke_id,
            "still": attempt.serial,
            "height_mm": stroke.height_mm,
            "tilt_deg": stroke.tilt_deg,
        }

    def _free_cell(self) -> Cell:
        state = self._store.state
        used = {cell for sheet, cell in state.used_cells if sheet == state.sheet}
        return self._sheet.free(used, state.sheet + 1)


async def uninterrupted(function: Callable[..., _R], *args: object) -> _R:
    """Run in a thread; a cancellation is passed on only once the function has returned.

    Half of a file operation is worse than one that ends a few milliseconds after the stop key.
    """
    task = asyncio.ensure_future(asyncio.to_thread(function, *args))
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise


def _number(step: Step, name: str) -> float:
    value = step.params[name]
    assert isinstance(value, float | int)
    return float(value)


def _in_words(step: Step) -> str:
    match step.kind:
        case StepKind.PRESS | StepKind.CAPTURE:
            return f"{step.kind} {step.params['stroke_id']}"
        case StepKind.DIP:
            return f"dip before stroke {step.index + 1}"
        case _:
            return step.kind.replace("_", " ")
