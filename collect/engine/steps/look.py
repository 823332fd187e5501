"""Looks at the sheet: is the board in view, and are the free cells blank."""

from __future__ import annotations

from calibrate.board.plane import Plane
from calibrate.board.view import see_board
from calibrate.errors import CalibrationError
from calibrate.stroke.preprocess import Gray
from collect.engine.steps.context import RunContext, StepContext
from collect.engine.steps.waiting import uninterrupted
from collect.errors import BadPicture, NeedsOperator, StepError
from collect.photograph.new_ink import gray
from collect.protocols.steps import Result
from collect.quality.checks import cell_is_blank, check_frame
from collect.quality.verdict import Check
from collect.rig.optics import straightened


async def board(context: StepContext) -> Result:
    """The BOARD step. Raises `StepError` where the board is not seen: nothing that follows could be measured."""
    image = await photograph(context)
    with context.recorder.sections.timed("see the board"):
        plane, checks = await uninterrupted(_board, context.run, image)
    return {
        "still": context.attempt.serial,
        "corners": plane.corners,
        "mm_per_px": plane.mm_per_px,
        "rms_px": plane.rms_px,
        **camera_delay(context),
        "checks": [
            {"name": str(c.name), "score": c.score, "threshold": c.threshold, "passed": c.passed} for c in checks
        ],
    }


async def look_at_sheet(context: StepContext) -> None:
    """Once for each sheet that is in: every free cell must be blank. Raises `NeedsOperator`.

    The operator says that a fresh sheet is in; the camera says whether that is so before ink goes on ink. A brush that
    was full of ink meanwhile counts as dry.
    """
    run = context.run
    sheet = run.store.state.sheet
    if run.known.looked_at_sheet == sheet or not run.rig.config.quality.enabled:
        return
    run.known.left_ink_ns = None
    with run.progress.meanwhile("look whether the sheet is blank"):
        image = await photograph(context)
        inked = await uninterrupted(_inked_cells, run, image, context.cell.index if context.cell is not None else None)
    if inked:
        raise NeedsOperator(
            f"{len(inked)} cells of sheet {sheet + 1} that should be blank are not: {inked[0]} "
            "Put in a blank sheet, or the one that belongs here."
        )
    run.known.looked_at_sheet = sheet


async def photograph(context: StepContext) -> Gray:
    """Park, take a fresh frame, record it as the still of this attempt, and hand it over in gray."""
    photographer = context.run.procedures.photographer
    known = photographer.delay
    with context.recorder.sections.timed("wait for a fresh frame"):
        frame = await context.run.procedures.capture()
    if photographer.delay is not known:
        context.recorder.log(f"camera delay: {photographer.delay}")
        context.run.progress.log(f"camera delay: {photographer.delay}")
    with context.recorder.sections.timed("encode still"):
        await uninterrupted(context.recorder.still, frame, context.attempt.serial)
    return await uninterrupted(straightened, context.run.rig.config.camera, gray(frame.image))


def camera_delay(context: StepContext) -> Result:
    """What is known of the camera's delay, for the journal."""
    delay = context.run.procedures.photographer.delay
    if delay is None:
        return {}
    return {"camera_delay_ms": round(1e3 * delay.delay_s, 1), "camera_jitter_ms": round(1e3 * delay.spread_s, 1)}


def image_plane(run: RunContext, image: Gray) -> Plane:
    """Where the paper is in this frame: from its own board, else from the newest that was seen."""
    try:
        run.known.image_plane = see_board(image, run.rig.config.board)
    except CalibrationError as error:
        if run.known.image_plane is None:
            raise BadPicture(f"the board is not seen: {error.what}") from None
    return run.known.image_plane


def _board(run: RunContext, image: Gray) -> tuple[Plane, tuple[Check, ...]]:
    try:
        plane = see_board(image, run.rig.config.board)
    except CalibrationError as error:
        raise StepError(f"the board is not seen: {error.what}") from None
    run.known.image_plane = plane
    limits = run.rig.config.quality
    frame = check_frame(image, plane, limits)
    if limits.enabled and frame.cause is not None:
        raise BadPicture(frame.cause.reason)
    return plane, frame.checks


def _inked_cells(run: RunContext, image: Gray, begun: int | None) -> list[str]:
    plane = image_plane(run, image)
    used = run.used_cells() - {begun}  # the cell of this very attempt is still to be pressed
    free = [run.sheet.cell(index) for index in range(run.sheet.capacity) if index not in used]
    checks = [cell_is_blank(image, plane, cell, limits=run.rig.config.quality) for cell in free]
    return [check.reason for check in checks if not check.passed]
