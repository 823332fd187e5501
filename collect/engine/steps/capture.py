"""Photographs a mark, judges it, and decides whether it counts."""

from __future__ import annotations

import contextlib

from collect.engine.last_capture import LastCapture, pictures_of, published_mark
from collect.engine.steps.choose import measured
from collect.engine.steps.context import RunContext, StepContext
from collect.engine.steps.look import Gray, camera_delay, image_plane, photograph
from collect.engine.steps.waited import wait_check
from collect.engine.steps.waiting import uninterrupted
from collect.errors import BadPicture, NeedsOperator, StepError
from collect.operator import Choice, OperatorRequest, Prompt
from collect.protocols.steps import Result
from collect.quality.checks import check_capture, check_drawing
from collect.quality.verdict import Family, Verdict
from collect.rig.paper import Cell
from sessions.recording.schemas import Check, Quality, Stroke

KEEP, AGAIN, SKIP = Choice("g", "good all the same: it counts"), Choice("r", "press it again"), Choice("k", "skip it")
PICTURE_MARGIN_PX = 40


async def capture(context: StepContext) -> Result:
    """The CAPTURE step: `kept` where the stroke counts, `retake` where it is to be made again on another cell.

    Raises `BadPicture` where the photograph, not the stroke, is at fault.
    """
    run, stroke_id = context.run, str(context.step.params["stroke_id"])
    if int(context.number("sheet")) != run.store.state.sheet:
        raise StepError(f"{stroke_id} lies on another sheet than the one that is in")
    cell = run.sheet.cell(int(context.number("cell")))
    image = await photograph(context)
    waited = wait_check(context)
    verdict = await _judged(context, image, cell, waited)
    run.known.sound_frame = image
    if run.asker.watched:
        await uninterrupted(_show, context, verdict, image, cell, True)
    kept, retake = True, False
    if run.requests.take(OperatorRequest.RETAKE):
        kept, retake = False, True
        run.progress.log(f"{stroke_id}: is pressed again, as the operator asked")
    elif run.requests.take(OperatorRequest.SKIP):
        kept = False
        run.progress.log(f"{stroke_id}: is left out, as the operator asked")
    elif verdict is not None and not verdict.passed:
        kept, retake = await _decide(context, verdict, image, cell)
    if not kept:
        run.progress.looked_at(kept=False)
    if kept:
        context.recorder.stroke(_stroke(context, cell, None if waited is None else waited.score))
    return {
        "stroke_id": stroke_id,
        "still": context.attempt.serial,
        "height_mm": context.number("height_mm"),
        "tilt_deg": context.number("tilt_deg"),
        "kept": kept,
        "retake": retake,
        **camera_delay(context),
        "verdict": "" if verdict is None or verdict.cause is None else str(verdict.cause.name),
        **(await measured(context, image, cell) if context.step.params.get("measured") else {}),
    }


async def _judged(context: StepContext, image: Gray, cell: Cell, waited: Check | None) -> Verdict | None:
    run, stroke_id = context.run, str(context.step.params["stroke_id"])
    if waited is not None and not waited.passed:
        run.progress.log(f"{stroke_id}: {waited.reason}", warning=True)
    if not run.rig.config.quality.enabled:
        return None
    with context.recorder.sections.timed("judge the capture"):
        verdict = await uninterrupted(_judge, context, image, cell)
    checks = tuple(
        Check(name=c.name, score=c.score, threshold=c.threshold, passed=c.passed, reason=c.reason)
        for c in verdict.checks
    )
    remarks = () if waited is None else (waited,)
    context.recorder.quality(Quality(stroke_id=stroke_id, checks=(*checks, *remarks)), context.attempt.serial)
    if verdict.cause is not None:
        run.progress.log(f"{stroke_id}: {verdict.reason}", warning=True)
        if verdict.cause.name.family is Family.PICTURE:
            raise BadPicture(verdict.cause.reason)
    return verdict


def _drawn(context: StepContext) -> bool:
    return bool(context.step.params.get("drawn"))


def _judge(context: StepContext, image: Gray, cell: Cell) -> Verdict:
    run, height_mm = context.run, context.number("height_mm")
    config, previous = run.rig.config, run.known.sound_frame
    if _drawn(context):
        plane = image_plane(run, image)
        return check_drawing(image, plane, cell, height_mm=height_mm, limits=config.quality, previous=previous)
    return check_capture(
        image,
        image_plane(run, image),
        cell,
        height_mm=height_mm,
        limits=config.quality,
        previous=previous,
        sheet_mm=config.paper.size_mm,
    )


async def _decide(context: StepContext, verdict: Verdict, image: Gray, cell: Cell) -> tuple[bool, bool]:
    """(kept, retake): again while takes are left, then a person decides; unwatched, the stroke is given up."""
    run = context.run
    take = int(context.step.params.get("take") or 1)
    if take <= run.rig.config.quality.retakes:
        return False, True
    stroke_id = str(context.step.params["stroke_id"])
    prompt = Prompt(
        f"{stroke_id}, take {take}: {verdict.reason}", (KEEP, AGAIN, SKIP), SKIP.key, image=_cut_out(run, image, cell)
    )
    try:
        with run.progress.meanwhile("wait for an answer"):
            answer = await run.asker.ask(prompt)
    except NeedsOperator:
        run.progress.log(f"{stroke_id}: given up", warning=True)
        return False, False
    return answer == KEEP.key, answer == AGAIN.key


def _show(context: StepContext, verdict: Verdict | None, image: Gray, cell: Cell, kept: bool) -> None:
    photo = binary = None
    with contextlib.suppress(BadPicture):
        photo, binary = pictures_of(image, image_plane(context.run, image), cell)
    stroke_id, still = str(context.step.params["stroke_id"]), context.attempt.serial
    height_mm, tilt_deg = context.number("height_mm"), context.number("tilt_deg")
    brush = context.run.rig.config.brush
    sizes = {"radius_mm": brush.radius_mm, "length_mm": brush.length_mm}
    model = None if _drawn(context) else published_mark(height_mm, tilt_deg, **sizes)
    context.run.progress.show(LastCapture(stroke_id, height_mm, tilt_deg, still, kept, verdict, photo, binary, model))


def _cut_out(run: RunContext, image: Gray, cell: Cell) -> Gray:
    """The cell and a little around it."""
    import numpy as np

    plane = run.known.image_plane
    assert plane is not None
    x_mm, y_mm, width_mm, height_mm = cell.rect_mm
    corners = np.array([[x, y, 1.0] for x in (x_mm, x_mm + width_mm) for y in (y_mm, y_mm + height_mm)])
    seen = corners @ np.linalg.inv(plane.image_to_paper).T
    px = seen[:, :2] / seen[:, 2:]
    (left, top), (right, bottom) = px.min(axis=0).astype(int), px.max(axis=0).astype(int)
    m = PICTURE_MARGIN_PX
    return image[max(0, top - m) : bottom + m, max(0, left - m) : right + m]


def _stroke(context: StepContext, cell: Cell, dip_to_touch_s: float | None) -> Stroke:
    return Stroke(
        stroke_id=str(context.step.params["stroke_id"]),
        kind="drag" if _drawn(context) else "press",
        still=context.attempt.serial,
        height_mm=context.number("height_mm"),
        tilt_deg=context.number("tilt_deg"),
        cell_mm=cell.rect_mm,
        anchor_mm=cell.anchor_mm,
        again_of=None if context.step.params.get("again_of") is None else str(context.step.params["again_of"]),
        dip_to_touch_s=dip_to_touch_s,
    )
