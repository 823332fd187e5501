"""The steps that leave ink on a patch: a press, and a drawn figure."""

from __future__ import annotations

import asyncio

from brushloop.collect.engine.steps.capture import look_at_sheet
from brushloop.collect.engine.steps.context import StepContext
from brushloop.collect.engine.steps.dip import DipToTouch, fill_brush, must_dip
from brushloop.collect.motion.moves import press_moves, stroke_moves
from brushloop.collect.motion.procedures import check_drawn, draw_stroke
from brushloop.collect.protocols.plan import Drawn
from brushloop.collect.protocols.steps import Result
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import Patch
from brushloop.sessions.history import WAIT


async def press(context: StepContext) -> Result:
    """The PRESS step."""
    patch, procedures = await _ready(context), context.run.procedures
    depth_mm, tilt_deg = context.number("depth_mm"), context.number("tilt_deg")
    down, _ = press_moves(context.run.rig.config, procedures.plane, patch, depth_mm, tilt_deg)
    with DipToTouch(context).watching() as timing:
        await timing.begin(down[0])
        pressing = procedures.press(patch, depth_mm, tilt_deg, context.number("dwell_s"))
        reached_mm = await context.guard.guarded(pressing)
    return _marked(context, reached_mm, context.guard.peak_n, timing)


async def draw(context: StepContext) -> Result:
    """The DRAW step: every stroke of a figure, with dips in between if the protocol asks for them."""
    run, drawn = context.run, Drawn.of(context.step)
    patch = await _ready(context)
    plane = run.procedures.plane
    config = run.rig.config
    await asyncio.to_thread(check_drawn, config, plane, limits_of(config), [patch], drawn)
    depths_mm: list[float] = []
    peaks_n: list[float] = []
    with DipToTouch(context).watching() as timing:
        for number, points in enumerate(drawn.strokes):
            if drawn.dips_before(number):
                await fill_brush(context)
            if run.memory.left_ink_ns is not None:
                await timing.begin(stroke_moves(config, plane, patch, points, drawn.speed_mm_s).down[0])
            stroke = draw_stroke(
                run.rig.robot,
                run.rig.config,
                plane,
                patch,
                points,
                speed_mm_s=drawn.speed_mm_s,
                blend_mm=drawn.blend_mm,
            )
            depths_mm.append(await context.guard.guarded(stroke))
            peaks_n.append(context.guard.peak_n)
    return {**_marked(context, max(depths_mm), max(peaks_n), timing), "depths_mm": depths_mm}


async def _ready(context: StepContext) -> Patch:
    """Check the sheet, fill the brush if its ink is old, and return the patch to press, which was seen to be blank."""
    assert context.patch is not None
    await look_at_sheet(context)
    if must_dip(context):
        # Resumed, paused, or the last press failed: the brush may have dried or lost its ink since its dip.
        context.recorder.log("dip again before the press")
        await fill_brush(context)
    return context.patch


def _marked(context: StepContext, depth_mm: float, peak_n: float, timing: DipToTouch) -> Result:
    assert context.patch is not None
    result: Result = {
        "stroke_id": context.step.params["stroke_id"],
        "sheet": context.run.store.state.sheet,
        "patch": context.patch.index,
        "depth_mm": depth_mm,
    }
    if timing.longest_s is not None:
        result[WAIT] = round(timing.longest_s, 3)
    return result if context.run.rig.force is None else {**result, "peak_force_n": peak_n}
