"""Presses and drawn figures: what leaves ink on a cell."""

from __future__ import annotations

import asyncio

from collect.drawing import Drawn, check_drawn, draw_stroke
from collect.rig import limits_of
from collect.sheet import Cell
from collect.steps import Result
from collect.work.context import Job
from collect.work.dipping import fill_brush
from collect.work.looking import look_at_sheet


async def press(job: Job) -> Result:
    """The PRESS step."""
    cell = await _ready(job)
    depth_mm = await job.guard.guarded(
        job.bench.procedures.press(cell, job.number("height_mm"), job.number("tilt_deg"), job.number("dwell_s"))
    )
    return _marked(job, depth_mm)


async def draw(job: Job) -> Result:
    """The DRAW step: every stroke of a figure, dipping between them where the protocol says so."""
    bench, drawn = job.bench, Drawn.of(job.step)
    cell = await _ready(job)
    plane = bench.procedures.plane
    config = bench.rig.config
    await asyncio.to_thread(check_drawn, config, plane, limits_of(config), [cell], drawn)
    depths_mm: list[float] = []
    for number, points in enumerate(drawn.strokes):
        if drawn.dips_before(number):
            await fill_brush(job)
        stroke = draw_stroke(
            bench.rig.robot,
            bench.rig.config,
            plane,
            cell,
            points,
            speed_mm_s=drawn.speed_mm_s,
            blend_mm=drawn.blend_mm,
        )
        depths_mm.append(await job.guard.guarded(stroke))
    bench.known.inked = False
    return {**_marked(job, max(depths_mm)), "depths_mm": depths_mm}


async def _ready(job: Job) -> Cell:
    """Ink on the brush and a cell that is blank."""
    cell, known = job.cell, job.bench.known
    assert cell is not None
    await look_at_sheet(job)
    if not known.inked:
        # Resumed, or the last press failed: the brush may have dried or lost its ink since its dip.
        job.recorder.log("dip again before the press")
        await fill_brush(job)
    known.inked = False
    return cell


def _marked(job: Job, depth_mm: float) -> Result:
    assert job.cell is not None
    result: Result = {
        "stroke_id": job.step.params["stroke_id"],
        "sheet": job.bench.store.state.sheet,
        "cell": job.cell.index,
        "depth_mm": depth_mm,
    }
    return result if job.bench.rig.force is None else {**result, "peak_force_n": job.guard.peak_n}
