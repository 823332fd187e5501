"""Into the ink and out again."""

from __future__ import annotations

from collect.inking import InkSeen
from collect.steps import Result
from collect.work.context import Job


async def dip(job: Job) -> Result:
    """The DIP step."""
    seen = await fill_brush(job)
    return {} if seen.level is None else {"ink_level": seen.level, "dosed_ml": seen.dosed_ml}


async def fill_brush(job: Job) -> InkSeen:
    """Fill up the well if need be, then dip."""
    bench = job.bench
    seen = await bench.inking.before_dip()
    if bench.rig.ink is not None:
        job.recorder.ink(seen.level, seen.dosed_ml, seen.light)
        bench.progress.inked(seen.level)
    await job.guard.guarded(bench.procedures.dip())
    bench.known.inked = True
    return seen
