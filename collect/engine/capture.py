"""Photographs: the BOARD step, the look at a blank sheet, the CAPTURE step, which strokes then count, and what a screen
shows of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.pix2len import Plane, see_board
from brushloop.calibrate.compare import ANCHOR_MM, MM_PER_PX, field_around, field_grid, shrunk
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, Gray, on_window, prepare, rectify
from brushloop.collect.engine.recorder import RunContext, StepContext, meanwhile, uninterrupted
from brushloop.collect.engine.snapshot import LastCapture
from brushloop.collect.errors import BadPicture, NeedsOperator, StepError
from brushloop.collect.motion import park_move
from brushloop.collect.operator import Choice, OperatorRequest, Prompt
from brushloop.collect.photograph.checks import Failure, Photograph, Verdict
from brushloop.collect.photograph.frames import undistorted
from brushloop.collect.photograph.measure import around
from brushloop.collect.protocols.steps import MARKING, CaptureStep
from brushloop.collect.rig.config import PaperConfig
from brushloop.collect.rig.paper import Patch
from brushloop.drivers.devices import Frame
from brushloop.model.fitted import FittedPress
from brushloop.sessions.events import Again, BoardResult, CaptureResult, Press, ReviewResult
from brushloop.sessions.recording import bad_stills
from brushloop.sessions.records import Check, Condition, Quality, Stroke, Topic

KEEP, AGAIN = Choice("g", "good anyway: the stroke counts"), Choice("r", "press the stroke again")
SKIP = Choice("k", "skip the stroke")
PICTURE_MARGIN_MM, PICTURE_PX_PER_MM = 10.0, 10.0
"""Margin around the patch, and scale, of the picture that goes with a question."""


async def decide(
    run: RunContext, press: Press, verdict: Verdict | None, image: Gray, patch: Patch
) -> tuple[bool, bool]:
    """Return (kept, retake) of the press in `image`: by the operator's request if there is one, else by the verdict.

    A stroke that failed is retaken while takes are left, then a person decides; without a screen it is left out. Raises
    `NeedsOperator` if the screen went away: the step stays open, and is done and asked about again on resume.
    """
    stroke_id = press.stroke_id
    if run.control.take(OperatorRequest.RETAKE):
        run.progress.log(f"{stroke_id}: is pressed again, as the operator requested")
        return False, True
    if run.control.take(OperatorRequest.SKIP):
        run.progress.log(f"{stroke_id}: is left out, as the operator requested")
        return False, False
    if verdict is None or verdict.passed:
        return True, False
    if press.take <= run.rig.config.quality.retakes:
        return False, True
    if not run.opening.request.on_screen:
        run.progress.log(f"{stroke_id}: left out", warning=True)
        return False, False
    text = f"{stroke_id}, take {press.take}: {verdict.reason}"
    window_mm = around(patch.rect_mm, PICTURE_MARGIN_MM, None)
    picture = rectify(image, run.board.plane.homography, window_mm, PICTURE_PX_PER_MM)
    await run.procedures.go(park_move(run.rig.config))  # a person may reach under the arm
    answer = await run.asker.ask(Prompt(text, (KEEP, AGAIN, SKIP), SKIP.key, image=picture))
    return answer == KEEP.key, answer == AGAIN.key


def marked_bad(run: RunContext) -> list[str]:
    """Strokes that count, are marked bad, and were not listed by a REVIEW step yet, in the order in which they were
    made. Raises `SessionDamaged`."""
    bad, state = bad_stills(run.store.folder), run.store.state
    listed = {again.stroke_id for review in state.results(ReviewResult) for again in review.again}
    captures = state.results(CaptureResult)
    counted = [capture.press.stroke_id for capture in captures if capture.kept and capture.still in bad]
    return [name for name in counted if name not in listed]


def review(run: RunContext) -> ReviewResult:
    """The REVIEW step: the strokes to press again."""
    free = 1 + max((stroke.index for stroke in run.progress.plan), default=0)
    again = tuple(Again(stroke_id=name, index=index) for index, name in enumerate(marked_bad(run), start=free))
    for stroke in again:
        run.progress.log(f"{stroke.stroke_id} was marked bad in the review and is pressed again")
    return ReviewResult(again=again)


MOVED_MM = 1.0
"""Distance by which the sheet may seem to have moved in the picture since the first mark of the session."""


async def board(context: StepContext) -> BoardResult:
    """The BOARD step. Raises `StepError` where the board is not seen: nothing that follows could be measured; and
    `NeedsOperator` where photographs have another size, or the board another place, than before the first mark."""
    image = await photograph(context)
    plane, checks = await uninterrupted(_board, context.run, image)
    delay_ms, jitter_ms = _camera_delay(context)
    return BoardResult(
        still=context.attempt.serial,
        corners=plane.corners,
        mm_per_px=plane.mm_per_px,
        rms_px=plane.rms_px,
        size_px=(image.shape[1], image.shape[0]),
        sheet_px=plane.to_image(_corners_mm(context.run.rig.config.paper)).tolist(),
        checks=checks,
        camera_delay_ms=delay_ms,
        camera_jitter_ms=jitter_ms,
    )


def _board(run: RunContext, image: Gray) -> tuple[Plane, tuple[Check, ...]]:
    try:
        board = see_board(image, run.rig.config.board)
    except CalibrationError as error:
        raise StepError(f"the board is not seen: {error.what}") from None
    if (before := _before_first_mark(run)) is not None:
        _check_view(before, image, board.plane, run.rig.config.paper)
    run.board = board
    limits = run.rig.config.quality
    frame = Photograph(image, board.plane, limits).check_frame()
    if limits.enabled and frame.cause is not None:
        raise BadPicture(frame.cause.reason)
    return board.plane, frame.checks


def _before_first_mark(run: RunContext) -> BoardResult | None:
    """The board as it was last seen before the session's first mark; None as long as there is no mark."""
    before = None
    for step in run.store.state.files.values():
        if step.kind in MARKING:
            return before
        if isinstance(step.result, BoardResult):
            before = step.result
    return None


def _corners_mm(paper: PaperConfig) -> NDArray[np.float64]:
    """(4, 2) corners of the sheet, in the paper frame."""
    width_mm, height_mm = paper.size_mm
    return np.array([[x_mm, y_mm] for x_mm in (0.0, width_mm) for y_mm in (0.0, height_mm)])


def _check_view(before: BoardResult, image: Gray, plane: Plane, paper: PaperConfig) -> None:
    """Raise `NeedsOperator` unless frame size and place of the board are those of the session's other strokes."""
    height_px, width_px = image.shape
    if (size_px := before.size_px) != (width_px, height_px):
        raise NeedsOperator(
            f"the camera gives pictures of {width_px} x {height_px} px; when the session began, they had {size_px[0]} "
            f"x {size_px[1]} px. Set the size back (camera.locked in rig.toml), or start a new session with --new."
        )
    seen_mm = plane.to_paper(np.array(before.sheet_px))
    moved_mm = float(np.linalg.norm(seen_mm - _corners_mm(paper), axis=1).max())
    if moved_mm > MOVED_MM:
        raise NeedsOperator(
            f"the board is seen {moved_mm:.1f} mm from its place at the start of the session (limit {MOVED_MM:g} mm): "
            "camera or board was moved. Put it back, or start a new session with --new."
        )


async def look_at_sheet(context: StepContext) -> None:
    """Once for each sheet, check that every free patch is blank. Raises `NeedsOperator`.

    The operator says that a fresh sheet is in; the camera confirms it, so that no press lands on old ink. A brush that
    was full of ink counts as dry afterwards.
    """
    run = context.run
    sheet = run.store.state.sheet
    if run.looked_at_sheet == sheet or not run.rig.config.quality.enabled:
        return
    run.left_ink_ns = None
    with run.progress.meanwhile("check that the sheet is blank"):
        image = await photograph(context)
        inked = await uninterrupted(_inked_patches, run, image, {patch.index for patch in context.patches})
    if inked:
        raise NeedsOperator(
            f"ink on patches of sheet {sheet + 1} that should be blank, {len(inked)} in all. The first: {inked[0]} "
            f"Put in a blank sheet, or sheet {sheet + 1} of this session."
        )
    run.looked_at_sheet = sheet


def _inked_patches(run: RunContext, image: Gray, begun: set[int]) -> list[str]:
    plane = run.image_plane(image)
    used = run.used_patches() - begun  # this attempt's own patch is not pressed yet
    free = [run.sheet.patch(index) for index in range(run.sheet.capacity) if index not in used]
    photograph = Photograph(image, plane, run.rig.config.quality, run.rig.config.paper.size_mm)
    return [check.reason for check in map(photograph.check_blank, free) if not check.passed]


async def photograph(context: StepContext) -> Gray:
    """Park, take a fresh frame, record it as the still of this attempt, and return it in gray, undistorted."""
    return await _recorded(context, await _fresh_frame(context))


async def _fresh_frame(context: StepContext) -> Frame:
    run, photographer = context.run, context.run.procedures.photographer
    if (known := photographer.delay) is None:
        run.progress.log("measuring the camera's delay: the arm goes over the sheet and back, two to six times")
    frame = await photographer.photograph()
    if photographer.delay is not known:
        measured = f"camera delay: {photographer.delay}; limit {run.rig.config.camera.max_delay_ms:g} ms"
        context.recorder.log(measured)
        run.progress.log(measured)
    return frame


async def _recorded(context: StepContext, frame: Frame) -> Gray:
    await uninterrupted(context.recorder.still, frame, context.attempt.serial)
    return await uninterrupted(undistorted, context.run.rig.config.camera, frame.image)


def _camera_delay(context: StepContext) -> tuple[float, float] | tuple[None, None]:
    """(delay of the camera, its variation), ms; None where they were not measured."""
    delay = context.run.procedures.photographer.delay
    return (None, None) if delay is None else (round(1e3 * delay.delay_s, 1), round(1e3 * delay.spread_s, 1))


async def capture(context: StepContext, step: CaptureStep) -> CaptureResult:
    """The CAPTURE step: `kept` if the stroke counts, `retake` if it must be pressed again on another patch.

    Once the frame is there, the arm goes where the next dip begins, if another stroke is planned, while the frame is
    recorded and judged. The brush is empty and stays so until the decision is in the journal: only the next step may
    dip it. Raises `BadPicture` if the photograph, not the stroke, is at fault.
    """
    run, press, still = context.run, step.press, context.attempt.serial
    if press.patch is None or press.sheet != run.store.state.sheet:
        raise StepError(f"{press.stroke_id} is not on the sheet that is in place")
    patch = run.sheet.patch(press.patch)
    frame = await _fresh_frame(context)
    looking = _looked_at(context, step, frame, patch)
    if any(stroke.stroke_id != press.stroke_id for stroke in run.progress.left):
        image, verdict = await meanwhile(context.guard.guarded(run.procedures.set_out()), looking)
    else:
        image, verdict = await looking  # a dip for a retake goes to the well by itself
    kept, retake = await decide(run, press, verdict, image, patch)
    if kept:
        context.recorder.event(Topic.STROKE, _stroke(step, patch, still), still)
    else:
        run.progress.not_kept()
    cause = None if verdict is None else verdict.cause
    delay_ms, jitter_ms = _camera_delay(context)
    return CaptureResult(
        press=press,
        still=still,
        kept=kept,
        retake=retake,
        verdict="" if cause is None else cause.name,
        camera_delay_ms=delay_ms,
        camera_jitter_ms=jitter_ms,
    )


async def _looked_at(
    context: StepContext, step: CaptureStep, frame: Frame, patch: Patch
) -> tuple[Gray, Verdict | None]:
    """Record the frame, judge the stroke in it unless captures are not judged, and show both; nothing moves here."""
    run, stroke_id, still = context.run, step.press.stroke_id, context.attempt.serial
    image = await _recorded(context, frame)
    verdict = None
    if run.rig.config.quality.enabled:
        verdict = await uninterrupted(_judge, run, step, image, patch)
        context.recorder.event(Topic.QUALITY, Quality(stroke_id=stroke_id, checks=verdict.checks), still)
        if verdict.cause is not None:
            run.progress.log(f"{stroke_id}: {verdict.reason}", warning=True)
            if Failure(verdict.cause.name).of_picture:
                raise BadPicture(verdict.cause.reason)
    run.sound_frame = image
    if run.asker.watched:
        await uninterrupted(_show, context, step, verdict, image, patch)
    return image, verdict


def _judge(run: RunContext, step: CaptureStep, image: Gray, patch: Patch) -> Verdict:
    config, plane = run.rig.config, run.image_plane(image)
    photograph = Photograph(image, plane, config.quality, config.paper.size_mm, run.sound_frame)
    judge = photograph.check_drawing if step.drawn else photograph.check_press
    return judge(patch, step.press.condition.depth_mm)


def _show(context: StepContext, step: CaptureStep, verdict: Verdict | None, image: Gray, patch: Patch) -> None:
    run = context.run
    photo, binary = pictures_of(image, run.board.plane, patch)
    brush, press = run.rig.config.brush, step.press
    published = FittedPress(brush.radius_mm, brush.length_mm)
    model = None if step.drawn else mark_of(published, press.condition)
    run.progress.show(LastCapture(press, context.attempt.serial, True, verdict, photo, binary, model))


def _stroke(step: CaptureStep, patch: Patch, still: int) -> Stroke:
    press = step.press
    return Stroke(
        stroke_id=press.stroke_id,
        kind="drag" if step.drawn else "press",
        still=still,
        depth_mm=press.condition.depth_mm,
        tilt_deg=press.condition.tilt_deg,
        heading_deg=press.condition.heading_deg,
        reached_mm=press.reached_mm,
        cell_mm=patch.rect_mm,
        anchor_mm=patch.anchor_mm,
        again_of=step.again_of,
        dip_to_touch_s=press.dip_to_touch_s,
    )


# What a screen shows of a capture


def mark_of(brush: FittedPress, condition: Condition) -> NDArray[np.bool_] | None:
    """Mark of a brush, (128, 128) on the default field; None if the model gives none there. Takes a few ms.

    A brush of which only radius and length are given leaves the mark of CCD-BSM as published.
    """
    grid = field_grid()
    try:
        chance = brush.chance(condition.depth_mm, condition.tilt_deg, grid.x_mm, grid.y_mm, MM_PER_PX)
    except ValueError:
        return None
    return np.asarray(chance > 0.5)


def pictures_of(image: Gray, plane: Plane, patch: Patch) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The field around the patch's zero-touch point, and its ink on 128 x 128 px, or None if there is no ink."""
    window = field_around(patch.anchor_mm)
    left, top = ANCHOR_MM
    raster = rectify(image, plane.homography, window)
    anchor_px = left * PX_PER_MM, top * PX_PER_MM
    try:
        prepared = prepare(raster, anchor_px, "the capture", on_window(patch.rect_mm, window))
    except CaptureRefused:
        return raster, None
    return raster, shrunk(prepared.mask.astype(np.float32)) > 0.5
