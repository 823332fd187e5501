"""Into the ink and out again; looked at the paper before, so that the ink does not wait for that."""

from __future__ import annotations

from collect.engine.inking import InkSeen
from collect.engine.steps.context import Job
from collect.engine.steps.look import look_at_sheet
from collect.protocols.steps import Result


async def dip(job: Job) -> Result:
    """The DIP step."""
    await look_at_sheet(job)
    seen = await fill_brush(job)
    return {} if seen.level is None else {"ink_level": seen.level, "dosed_ml": seen.dosed_ml}


async def fill_brush(job: Job) -> InkSeen:
    """Fill up the well if need be, then dip."""
    bench = job.bench
    with bench.progress.meanwhile("dip"):
        seen = await bench.inking.before_dip()
        if bench.rig.ink is not None:
            job.recorder.ink(seen.level, seen.dosed_ml, seen.light)
            bench.progress.inked(seen.level)
        await job.guard.guarded(bench.procedures.dip())
        bench.known.left_ink_ns = bench.rig.clock.now_ns()
    return seen
