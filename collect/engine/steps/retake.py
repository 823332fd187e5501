"""Decides which strokes count, are pressed again on another patch, or are left out: after a capture, and in review.

That a photograph is taken again, and a failed step done again, is decided in `collect.engine.policy`.
"""

from __future__ import annotations

import numpy as np

from brushloop.calibrate.stroke import Gray
from brushloop.collect.engine.steps.context import RunContext
from brushloop.collect.operator import Choice, OperatorRequest, Prompt
from brushloop.collect.quality.verdict import Verdict
from brushloop.collect.rig.paper import Patch
from brushloop.sessions.events import Again, CaptureResult, Press, ReviewResult
from brushloop.sessions.recording import remarks_of

KEEP, AGAIN, SKIP = Choice("g", "good anyway: it counts"), Choice("r", "press it again"), Choice("k", "skip it")
PICTURE_MARGIN_PX = 40
"""Margin around the patch in the picture that goes with a question."""


async def decide(
    run: RunContext, press: Press, verdict: Verdict | None, image: Gray, patch: Patch
) -> tuple[bool, bool]:
    """Return (kept, retake) of the press in `image`, by the operator's request if there is one, else the verdict."""
    stroke_id = press.stroke_id
    if run.requests.take(OperatorRequest.RETAKE):
        run.progress.log(f"{stroke_id}: is pressed again, as the operator requested")
        return False, True
    if run.requests.take(OperatorRequest.SKIP):
        run.progress.log(f"{stroke_id}: is left out, as the operator requested")
        return False, False
    if verdict is None or verdict.passed:
        return True, False
    return await _after_failure(run, press, verdict, image, patch)


async def _after_failure(
    run: RunContext, press: Press, verdict: Verdict, image: Gray, patch: Patch
) -> tuple[bool, bool]:
    """Retake while takes are left, then let a person decide; without a screen, leave the stroke out.

    Raises `NeedsOperator` if the screen went away: the step stays open, and is done and asked about again on resume.
    """
    if press.take <= run.rig.config.quality.retakes:
        return False, True
    text = f"{press.stroke_id}, take {press.take}: {verdict.reason}"
    prompt = Prompt(text, (KEEP, AGAIN, SKIP), SKIP.key, image=_cut_out(run, image, patch))
    if not run.asker.attended:
        run.progress.log(f"{press.stroke_id}: left out", warning=True)
        return False, False
    await run.procedures.park()  # a person may reach under the arm
    answer = await run.asker.ask(prompt)
    return answer == KEEP.key, answer == AGAIN.key


def _cut_out(run: RunContext, image: Gray, patch: Patch) -> Gray:
    """The patch and a margin around it."""
    plane = run.view
    assert plane is not None
    x_mm, y_mm, size_x_mm, size_y_mm = patch.rect_mm
    corners = np.array([[x, y, 1.0] for x in (x_mm, x_mm + size_x_mm) for y in (y_mm, y_mm + size_y_mm)])
    seen = corners @ np.linalg.inv(plane.homography).T
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
    state = run.store.state
    listed = {again.stroke_id for review in state.results(ReviewResult) for again in review.again}
    bad = {remark.still for remark in remarks.values() if remark.bad}
    counted = [one.press.stroke_id for one in state.results(CaptureResult) if one.kept and one.still in bad]
    return [name for name in counted if name not in listed]


async def review(run: RunContext) -> ReviewResult:
    """The REVIEW step: the strokes to press again."""
    reviews = run.store.state.results(ReviewResult)
    first = run.progress.first_free_index + sum(len(review.again) for review in reviews)
    again = tuple(Again(stroke_id=name, index=first + n) for n, name in enumerate(marked_bad(run)))
    for one in again:
        run.progress.log(f"{one.stroke_id} was marked bad in the review and is pressed again")
    return ReviewResult(again=again)
