"""Decides whether a stroke counts, is pressed again on another cell, or is left out."""

from __future__ import annotations

import numpy as np

from calibrate.stroke.params import Gray
from collect.engine.steps.context import RunContext, StepContext
from collect.errors import NeedsOperator
from collect.operator import Choice, OperatorRequest, Prompt
from collect.quality.verdict import Verdict
from collect.rig.paper import Cell

KEEP, AGAIN, SKIP = Choice("g", "good anyway: it counts"), Choice("r", "press it again"), Choice("k", "skip it")
PICTURE_MARGIN_PX = 40
"""Margin around the cell in the picture that goes with a question."""


async def decide(context: StepContext, verdict: Verdict | None, image: Gray, cell: Cell) -> tuple[bool, bool]:
    """Return (kept, retake) of the stroke in `image`, by the operator's request if there is one, else the verdict."""
    run, stroke_id = context.run, str(context.step.params["stroke_id"])
    if run.requests.take(OperatorRequest.RETAKE):
        run.progress.log(f"{stroke_id}: is pressed again, as the operator requested")
        return False, True
    if run.requests.take(OperatorRequest.SKIP):
        run.progress.log(f"{stroke_id}: is left out, as the operator requested")
        return False, False
    if verdict is None or verdict.passed:
        return True, False
    return await _after_failure(context, verdict, image, cell)


async def _after_failure(context: StepContext, verdict: Verdict, image: Gray, cell: Cell) -> tuple[bool, bool]:
    """Retake while takes are left, then let a person decide; if nobody watches, give the stroke up."""
    run = context.run
    take = int(context.step.params.get("take") or 1)
    if take <= run.rig.config.quality.retakes:
        return False, True
    stroke_id = str(context.step.params["stroke_id"])
    text = f"{stroke_id}, take {take}: {verdict.reason}"
    prompt = Prompt(text, (KEEP, AGAIN, SKIP), SKIP.key, image=_cut_out(run, image, cell))
    if run.asker.watched:
        await run.procedures.park()  # a person may reach under the arm
    try:
        with run.progress.meanwhile("wait for an answer"):
            answer = await run.asker.ask(prompt)
    except NeedsOperator:
        run.progress.log(f"{stroke_id}: given up", warning=True)
        return False, False
    return answer == KEEP.key, answer == AGAIN.key


def _cut_out(run: RunContext, image: Gray, cell: Cell) -> Gray:
    """The cell and a margin around it."""
    plane = run.memory.image_plane
    assert plane is not None
    x_mm, y_mm, width_mm, height_mm = cell.rect_mm
    corners = np.array([[x, y, 1.0] for x in (x_mm, x_mm + width_mm) for y in (y_mm, y_mm + height_mm)])
    seen = corners @ np.linalg.inv(plane.image_to_paper).T
    px = seen[:, :2] / seen[:, 2:]
    (left, top), (right, bottom) = px.min(axis=0).astype(int), px.max(axis=0).astype(int)
    m = PICTURE_MARGIN_PX
    return image[max(0, top - m) : bottom + m, max(0, left - m) : right + m]
