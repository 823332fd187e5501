"""Looks at the sheet: is the board in view, and are the free cells blank."""

from __future__ import annotations

from calibrate.board.scale import PlaneFit, see_board
from calibrate.errors import CalibrationError
from calibrate.stroke.preprocess import Gray
from collect.engine.steps.context import Bench, Job
from collect.engine.steps.waiting import uninterrupted
from collect.errors import BadPicture, NeedsOperator, StepError
from collect.photograph.ink import gray
from collect.protocols.steps import Result
from collect.quality.check import cell_is_blank, check_frame
from collect.quality.verdict import Check
from collect.rig.optics import straightened


async def board(job: Job) -> Result:
    """The BOARD step. Raises `StepError` where the board is not seen: nothing that follows could be measured."""
    image = await photograph(job)
    with job.recorder.sections.timed("see the board"):
        plane, checks = await uninterrupted(_board, job.bench, image)
    return {
        "still": job.attempt.serial,
        "corners": plane.corners,
        "mm_per_px": plane.mm_per_px,
        "rms_px": plane.rms_px,
        **camera_delay(job),
        "checks": [
            {"name": str(c.name), "score": c.score, "threshold": c.threshold, "passed": c.passed} for c in checks
        ],
    }


async def look_at_sheet(job: Job) -> None:
    """Once for each sheet that is in: every free cell must be blank. Raises `NeedsOperator`.

    The operator says that a fresh sheet is in; the camera says whether that is so before ink goes on ink. A brush that
    was full of ink meanwhile counts as dry.
    """
    bench = job.bench
    sheet = bench.store.state.sheet
    if bench.known.looked_at_sheet == sheet or not bench.rig.config.quality.enabled:
        return
    bench.known.left_ink_ns = None
    with bench.progress.meanwhile("look whether the sheet is blank"):
        image = await photograph(job)
        inked = await uninterrupted(_inked_cells, bench, image, job.cell.index if job.cell is not None else None)
    if inked:
        raise NeedsOperator(
            f"{len(inked)} cells of sheet {sheet + 1} that should be blank are not: {inked[0]} "
            "Put in a blank sheet, or the one that belongs here."
        )
    bench.known.looked_at_sheet = sheet


async def photograph(job: Job) -> Gray:
    """Park, take a fresh frame, record it as the still of this attempt, and hand it over in gray."""
    photographer = job.bench.procedures.photographer
    known = photographer.delay
    with job.recorder.sections.timed("wait for a fresh frame"):
        frame = await job.bench.procedures.capture()
    if photographer.delay is not known:
        job.recorder.log(f"camera delay: {photographer.delay}")
        job.bench.progress.log(f"camera delay: {photographer.delay}")
    with job.recorder.sections.timed("encode still"):
        await uninterrupted(job.recorder.still, frame, job.attempt.serial)
    return await uninterrupted(straightened, job.bench.rig.config.camera, gray(frame.image))


def camera_delay(job: Job) -> Result:
    """What is known of the camera's delay, for the journal."""
    delay = job.bench.procedures.photographer.delay
    if delay is None:
        return {}
    return {"camera_delay_ms": round(1e3 * delay.delay_s, 1), "camera_jitter_ms": round(1e3 * delay.spread_s, 1)}


def image_plane(bench: Bench, image: Gray) -> PlaneFit:
    """Where the paper is in this frame: from its own board, else from the newest that was seen."""
    try:
        bench.known.image_plane = see_board(image, bench.rig.config.board)
    except CalibrationError as error:
        if bench.known.image_plane is None:
            raise BadPicture(f"the board is not seen: {error.what}") from None
    return bench.known.image_plane


def _board(bench: Bench, image: Gray) -> tuple[PlaneFit, tuple[Check, ...]]:
    try:
        plane = see_board(image, bench.rig.config.board)
    except CalibrationError as error:
        raise StepError(f"the board is not seen: {error.what}") from None
    bench.known.image_plane = plane
    limits = bench.rig.config.quality
    frame = check_frame(image, plane, limits)
    if limits.enabled and frame.cause is not None:
        raise BadPicture(frame.cause.reason)
    return plane, frame.checks


def _inked_cells(bench: Bench, image: Gray, begun: int | None) -> list[str]:
    plane = image_plane(bench, image)
    used = bench.used_cells() - {begun}  # the cell of this very attempt is still to be pressed
    free = [bench.sheet.cell(index) for index in range(bench.sheet.capacity) if index not in used]
    checks = [cell_is_blank(image, plane, cell, limits=bench.rig.config.quality) for cell in free]
    return [check.reason for check in checks if not check.passed]
