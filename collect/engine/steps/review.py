"""Finds strokes to press again, because a person marked their captures bad while the session was open."""

from __future__ import annotations

from collect.engine.steps.context import RunContext, StepContext
from collect.protocols.steps import Result, StepKind
from sessions.remarks import remarks_of


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
