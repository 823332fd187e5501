"""The steps that leave ink on a patch: a press, and a drawn figure."""

from __future__ import annotations

import asyncio

from brushloop.collect.engine.steps.capture import look_at_sheet
from brushloop.collect.engine.steps.context import StepContext
from brushloop.collect.engine.steps.dip import DipToTouch, fill_brush, must_dip
from brushloop.collect.motion.moves import press_moves, stroke_moves
from brushloop.collect.motion.procedures import check_drawn
from brushloop.collect.protocols.steps import DrawStep, PressStep
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import Patch
from brushloop.sessions.events import Press, PressResult, StepKind


async def press(context: StepContext, step: PressStep) -> PressResult:
    """The PRESS step."""
    patch, procedures = await _ready(context), context.run.procedures
    down, _ = press_moves(context.run.rig.config, procedures.plane, patch, step.press.condition)
    with DipToTouch(context).watching() as timing:
        await timing.begin(down[0])
        pressing = procedures.press(patch, step.press.condition, step.dwell_s)
        reached_mm = await context.guard.guarded(pressing)
    made = _made(context, step.press, reached_mm, timing)
    return PressResult(press=made, peak_force_n=_peak_n(context, context.guard.peak_n))


async def draw(context: StepContext, step: DrawStep) -> PressResult:
    """The DRAW step: every stroke of a figure, with dips in between if the protocol asks for them."""
    run, drawn = context.run, step.drawn
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
            if run.left_ink_ns is not None:
                await timing.begin(stroke_moves(config, plane, patch, points, drawn.speed_mm_s).down[0])
            depths_mm.append(await context.guard.guarded(run.procedures.stroke(patch, drawn, number)))
            peaks_n.append(context.guard.peak_n)
    made = _made(context, step.press, max(depths_mm), timing)
    return PressResult(
        kind=StepKind.DRAW, press=made, peak_force_n=_peak_n(context, max(peaks_n)), depths_mm=tuple(depths_mm)
    )


async def _ready(context: StepContext) -> Patch:
    """Check the sheet, fill the brush if its ink is old, and return the patch to press, which was seen to be blank."""
    assert context.patch is not None
    await look_at_sheet(context)
    if must_dip(context):
        # Resumed, paused, or the last press failed: the brush may have dried or lost its ink since its dip.
        context.recorder.log("dip again before the press")
        await fill_brush(context)
    return context.patch


def _made(context: StepContext, press: Press, reached_mm: float, timing: DipToTouch) -> Press:
    """The press with its place, and what was measured of it."""
    assert context.patch is not None
    wait_s = None if timing.longest_s is None else round(timing.longest_s, 3)
    place = {"sheet": context.run.store.state.sheet, "patch": context.patch.index}
    return press.model_copy(update={**place, "reached_mm": reached_mm, "dip_to_touch_s": wait_s})


def _peak_n(context: StepContext, peak_n: float) -> float | None:
    return None if context.run.rig.force is None else peak_n
