"""Photographs a mark, judges it, and decides whether it counts."""

from __future__ import annotations

import contextlib

from collect.engine.last_capture import LastCapture, pictures_of, published_mark
from collect.engine.steps.choose import measured
from collect.engine.steps.context import Bench, Job
from collect.engine.steps.look import Gray, camera_delay, image_plane, photograph
from collect.engine.steps.waited import wait_check
from collect.engine.steps.waiting import uninterrupted
from collect.errors import BadPicture, NeedsOperator, StepError
from collect.operator.questions import Choice, Prompt
from collect.operator.requests import Wish
from collect.protocols.steps import Result
from collect.quality.check import check_capture, check_drawing
from collect.quality.verdict import Family, Verdict
from collect.rig.sheet import Cell
from sessions.recording.schemas import Check, Quality, Stroke

KEEP, AGAIN, SKIP = Choice("g", "good all the same: it counts"), Choice("r", "press it again"), Choice("k", "skip it")
PICTURE_MARGIN_PX = 40


async def capture(job: Job) -> Result:
    """The CAPTURE step: `kept` where the stroke counts, `retake` where it is to be made again on another cell.

    Raises `BadPicture` where the photograph, not the stroke, is at fault.
    """
    bench, stroke_id = job.bench, str(job.step.params["stroke_id"])
    if int(job.number("sheet")) != bench.store.state.sheet:
        raise StepError(f"{stroke_id} lies on another sheet than the one that is in")
    cell = bench.sheet.cell(int(job.number("cell")))
    image = await photograph(job)
    waited = wait_check(job)
    verdict = await _judged(job, image, cell, waited)
    bench.known.sound_frame = image
    if bench.asker.watched:
        await uninterrupted(_show, job, verdict, image, cell, True)
    kept, retake = True, False
    if bench.wishes.take(Wish.RETAKE):
        kept, retake = False, True
        bench.progress.log(f"{stroke_id}: is pressed again, as the operator asked")
    elif bench.wishes.take(Wish.SKIP):
        kept = False
        bench.progress.log(f"{stroke_id}: is left out, as the operator asked")
    elif verdict is not None and not verdict.passed:
        kept, retake = await _decide(job, verdict, image, cell)
    if not kept:
        bench.progress.looked_at(kept=False)
    if kept:
        job.recorder.stroke(_stroke(job, cell, None if waited is None else waited.score))
    return {
        "stroke_id": stroke_id,
        "still": job.attempt.serial,
        "height_mm": job.number("height_mm"),
        "tilt_deg": job.number("tilt_deg"),
        "kept": kept,
        "retake": retake,
        **camera_delay(job),
        "verdict": "" if verdict is None or verdict.cause is None else str(verdict.cause.name),
        **(await measured(job, image, cell) if job.step.params.get("measured") else {}),
    }


async def _judged(job: Job, image: Gray, cell: Cell, waited: Check | None) -> Verdict | None:
    bench, stroke_id = job.bench, str(job.step.params["stroke_id"])
    if waited is not None and not waited.passed:
        bench.progress.log(f"{stroke_id}: {waited.reason}", warning=True)
    if not bench.rig.config.quality.enabled:
        return None
    with job.recorder.sections.timed("judge the capture"):
        verdict = await uninterrupted(_judge, job, image, cell)
    checks = tuple(
        Check(name=c.name, score=c.score, threshold=c.threshold, passed=c.passed, reason=c.reason)
        for c in verdict.checks
    )
    remarks = () if waited is None else (waited,)
    job.recorder.quality(Quality(stroke_id=stroke_id, checks=(*checks, *remarks)), job.attempt.serial)
    if verdict.cause is not None:
        bench.progress.log(f"{stroke_id}: {verdict.reason}", warning=True)
        if verdict.cause.name.family is Family.PICTURE:
            raise BadPicture(verdict.cause.reason)
    return verdict


def _drawn(job: Job) -> bool:
    return bool(job.step.params.get("drawn"))


def _judge(job: Job, image: Gray, cell: Cell) -> Verdict:
    bench, height_mm = job.bench, job.number("height_mm")
    config, previous = bench.rig.config, bench.known.sound_frame
    if _drawn(job):
        plane = image_plane(bench, image)
        return check_drawing(image, plane, cell, height_mm=height_mm, limits=config.quality, previous=previous)
    return check_capture(
        image,
        image_plane(bench, image),
        cell,
        height_mm=height_mm,
        limits=config.quality,
        previous=previous,
        sheet_mm=config.paper.size_mm,
    )


async def _decide(job: Job, verdict: Verdict, image: Gray, cell: Cell) -> tuple[bool, bool]:
    """(kept, retake): again while takes are left, then a person decides; unwatched, the stroke is given up."""
    bench = job.bench
    take = int(job.step.params.get("take") or 1)
    if take <= bench.rig.config.quality.retakes:
        return False, True
    stroke_id = str(job.step.params["stroke_id"])
    prompt = Prompt(
        f"{stroke_id}, take {take}: {verdict.reason}", (KEEP, AGAIN, SKIP), SKIP.key, image=_cut_out(bench, image, cell)
    )
    try:
        with bench.progress.meanwhile("wait for an answer"):
            answer = await bench.asker.ask(prompt)
    except NeedsOperator:
        bench.progress.log(f"{stroke_id}: given up", warning=True)
        return False, False
    return answer == KEEP.key, answer == AGAIN.key


def _show(job: Job, verdict: Verdict | None, image: Gray, cell: Cell, kept: bool) -> None:
    photo = binary = None
    with contextlib.suppress(BadPicture):
        photo, binary = pictures_of(image, image_plane(job.bench, image), cell)
    stroke_id, still = str(job.step.params["stroke_id"]), job.attempt.serial
    height_mm, tilt_deg = job.number("height_mm"), job.number("tilt_deg")
    brush = job.bench.rig.config.brush
    sizes = {"radius_mm": brush.radius_mm, "length_mm": brush.length_mm}
    model = None if _drawn(job) else published_mark(height_mm, tilt_deg, **sizes)
    job.bench.progress.show(LastCapture(stroke_id, height_mm, tilt_deg, still, kept, verdict, photo, binary, model))


def _cut_out(bench: Bench, image: Gray, cell: Cell) -> Gray:
    """The cell and a little around it."""
    import numpy as np

    plane = bench.known.image_plane
    assert plane is not None
    x_mm, y_mm, width_mm, height_mm = cell.rect_mm
    corners = np.array([[x, y, 1.0] for x in (x_mm, x_mm + width_mm) for y in (y_mm, y_mm + height_mm)])
    seen = corners @ np.linalg.inv(plane.image_to_paper).T
    px = seen[:, :2] / seen[:, 2:]
    (left, top), (right, bottom) = px.min(axis=0).astype(int), px.max(axis=0).astype(int)
    m = PICTURE_MARGIN_PX
    return image[max(0, top - m) : bottom + m, max(0, left - m) : right + m]


def _stroke(job: Job, cell: Cell, dip_to_touch_s: float | None) -> Stroke:
    return Stroke(
        stroke_id=str(job.step.params["stroke_id"]),
        kind="drag" if _drawn(job) else "press",
        still=job.attempt.serial,
        height_mm=job.number("height_mm"),
        tilt_deg=job.number("tilt_deg"),
        cell_mm=cell.rect_mm,
        anchor_mm=cell.anchor_mm,
        again_of=None if job.step.params.get("again_of") is None else str(job.step.params["again_of"]),
        dip_to_touch_s=dip_to_touch_s,
    )
