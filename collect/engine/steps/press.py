"""Presses and drawn figures: what leaves ink on a cell."""

from __future__ import annotations

import asyncio

from collect.engine.steps.context import Job
from collect.engine.steps.dip import fill_brush
from collect.engine.steps.look import look_at_sheet
from collect.engine.steps.waited import DipToTouch, stale
from collect.motion.drawing import Drawn, check_drawn, draw_stroke, stroke_moves
from collect.motion.procedures import press_moves
from collect.protocols.steps import Result
from collect.rig.devices import limits_of
from collect.rig.sheet import Cell
from sessions.waits import WAIT


async def press(job: Job) -> Result:
    """The PRESS step."""
    cell, procedures = await _ready(job), job.bench.procedures
    height_mm, tilt_deg = job.number("height_mm"), job.number("tilt_deg")
    down, _ = press_moves(job.bench.rig.config, procedures.plane, cell, height_mm, tilt_deg)
    with DipToTouch(job).watching() as waited:
        await waited.begin(down[0])
        depth_mm = await job.guard.guarded(procedures.press(cell, height_mm, tilt_deg, job.number("dwell_s")))
    return _marked(job, depth_mm, waited)


async def draw(job: Job) -> Result:
    """The DRAW step: every stroke of a figure, dipping between them where the protocol says so."""
    bench, drawn = job.bench, Drawn.of(job.step)
    cell = await _ready(job)
    plane = bench.procedures.plane
    config = bench.rig.config
    await asyncio.to_thread(check_drawn, config, plane, limits_of(config), [cell], drawn)
    depths_mm: list[float] = []
    with DipToTouch(job).watching() as waited:
        for number, points in enumerate(drawn.strokes):
            if drawn.dips_before(number):
                await fill_brush(job)
            if bench.known.left_ink_ns is not None:
                await waited.begin(stroke_moves(config, plane, cell, points, drawn.speed_mm_s).down[0])
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
    return {**_marked(job, max(depths_mm), waited), "depths_mm": depths_mm}


async def _ready(job: Job) -> Cell:
    """Ink on the brush that has not waited, and a cell that is blank."""
    assert job.cell is not None
    await look_at_sheet(job)
    if stale(job):
        # Resumed, paused, or the last press failed: the brush may have dried or lost its ink since its dip.
        job.recorder.log("dip again before the press")
        await fill_brush(job)
    return job.cell


def _marked(job: Job, depth_mm: float, waited: DipToTouch) -> Result:
    assert job.cell is not None
    result: Result = {
        "stroke_id": job.step.params["stroke_id"],
        "sheet": job.bench.store.state.sheet,
        "cell": job.cell.index,
        "depth_mm": depth_mm,
    }
    if waited.longest_s is not None:
        result[WAIT] = round(waited.longest_s, 3)
    return result if job.bench.rig.force is None else {**result, "peak_force_n": job.guard.peak_n}
