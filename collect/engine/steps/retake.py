"""Decides which strokes count, are pressed again on another patch, or are left out: after a capture, and in review.

That a photograph is taken again, and a failed step done again, is decided in `collect.engine.policy`.
"""

from __future__ import annotations

import numpy as np

from brushloop.calibrate.stroke.params import Gray
from brushloop.collect.engine.steps.context import RunContext, StepContext
from brushloop.collect.operator import Choice, OperatorRequest, Prompt
from brushloop.collect.protocols.steps import Result, StepKind
from brushloop.collect.quality.verdict import Verdict
from brushloop.collect.rig.paper import Patch
from brushloop.sessions.remarks import remarks_of

KEEP, AGAIN, SKIP = Choice("g", "good anyway: it counts"), Choice("r", "press it again"), Choice("k", "skip it")
PICTURE_MARGIN_PX = 40
"""Margin around the patch in the picture that goes with a question."""


async def decide(context: StepContext, verdict: Verdict | None, image: Gray, patch: Patch) -> tuple[bool, bool]:
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
    return await _after_failure(context, verdict, image, patch)


async def _after_failure(context: StepContext, verdict: Verdict, image: Gray, patch: Patch) -> tuple[bool, bool]:
    """Retake while takes are left, then let a person decide; without a screen, leave the stroke out.

    Raises `NeedsOperator` if the screen went away: the step stays open, and is done and asked about again on resume.
    """
    run = context.run
    take = int(context.step.params.get("take") or 1)
    if take <= run.rig.config.quality.retakes:
        return False, True
    stroke_id = str(context.step.params["stroke_id"])
    text = f"{stroke_id}, take {take}: {verdict.reason}"
    prompt = Prompt(text, (KEEP, AGAIN, SKIP), SKIP.key, image=_cut_out(run, image, patch))
    if not run.asker.attended:
        run.progress.log(f"{stroke_id}: left out", warning=True)
        return False, False
    await run.procedures.park()  # a person may reach under the arm
    answer = await run.asker.ask(prompt)
    return answer == KEEP.key, answer == AGAIN.key


def _cut_out(run: RunContext, image: Gray, patch: Patch) -> Gray:
    """The patch and a margin around it."""
    plane = run.memory.image_plane
    assert plane is not None
    x_mm, y_mm, size_x_mm, size_y_mm = patch.rect_mm
    corners = np.array([[x, y, 1.0] for x in (x_mm, x_mm + size_x_mm) for y in (y_mm, y_mm + size_y_mm)])
    seen = corners @ np.linalg.inv(plane.image_to_paper).T
    px = seen[:, :2] / seen[:, 2:]
    (left, top), (right, bottom) = px.min(axis=0).astype(int), px.max(axis=0).astype(int)
    m = PICTURE_MARGIN_PX
    return image[max(0, top - m) : bottom + m, max(0, left - m) : right + m]


def marked_bad(run: RunContext) -> list[str]:
    """Strokes that count, are marked bad, and were not listed by a REVIEW step yet, in the order in which they were
    made. Raises `SessionDamaged`."""
    remarks = remarks_of(run.store.folder)
    if not remarks:
        return []
    lines = run.store.state.segments
    given = {str(name) for line in lines if line["kind"] == StepKind.REVIEW for name, _ in line["result"]["again"]}
    captures = [line["result"] for line in lines if line["kind"] == StepKind.CAPTURE]
    bad = {remark.still for remark in remarks.values() if remark.bad}
    counted = [str(r["stroke_id"]) for r in captures if r.get("kept", True) and int(r["still"]) in bad]
    return [name for name in counted if name not in given]


async def review(context: StepContext) -> Result:
    """The REVIEW step: `again` holds [stroke_id, index of its new steps] of each stroke to press again."""
    run = context.run
    lines = [line["result"]["again"] for line in run.store.state.segments if line["kind"] == StepKind.REVIEW]
    first = run.progress.first_free_index + sum(map(len, lines))
    again = [[name, first + n] for n, name in enumerate(marked_bad(run))]
    for name, _ in again:
        run.progress.log(f"{name} was marked bad in the review and is pressed again")
    return {"again": again}
