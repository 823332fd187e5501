"""Into the ink and out again; looked at the paper before, so that the ink does not wait for that."""

from __future__ import annotations

from collect.engine.inking import InkSeen
from collect.engine.steps.context import StepContext
from collect.engine.steps.look import look_at_sheet
from collect.protocols.steps import Result


async def dip(context: StepContext) -> Result:
    """The DIP step."""
    await look_at_sheet(context)
    seen = await fill_brush(context)
    return {} if seen.level is None else {"ink_level": seen.level, "dosed_ml": seen.dosed_ml}


async def fill_brush(context: StepContext) -> InkSeen:
    """Fill up the well if need be, then dip."""
    run = context.run
    with run.progress.meanwhile("dip"):
        seen = await run.inking.before_dip()
        if run.rig.ink is not None:
            context.recorder.ink(seen.level, seen.dosed_ml, seen.light)
            run.progress.inked(seen.level)
        await context.guard.guarded(run.procedures.dip())
        run.known.left_ink_ns = run.rig.clock.now_ns()
    return seen
