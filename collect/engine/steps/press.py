"""The dip, the time from there until the ink meets the paper, and the steps that leave ink on a patch."""

from __future__ import annotations

import asyncio
from collections.abc import Generator
from contextlib import contextmanager

from brushloop.collect.engine.steps.capture import look_at_sheet
from brushloop.collect.engine.steps.context import RunContext, StepContext, within_limits
from brushloop.collect.motion import TOUCH_TOLERANCE_MM, Move, press_moves, stroke_moves
from brushloop.collect.planning.limit_check import check_step
from brushloop.collect.protocols.steps import DrawStep, PressStep
from brushloop.collect.rig.paper import Patch
from brushloop.drivers.devices import PoseSample, Well
from brushloop.sessions.events import DipResult, Press, PressResult, StepKind

STALE_INK_S = 5.0
"""After a longer wait (a pause, a question, a photograph) the brush dips again before it presses."""


async def dip(context: StepContext) -> DipResult:
    """The DIP step. Looks at the sheet first, so that the filled brush does not wait for it."""
    await look_at_sheet(context)
    well = await fill_brush(context)
    if well is None or well.level is None:
        return DipResult()
    return DipResult(ink_level=well.level, dosed_ml=well.dosed_ml)


async def fill_brush(context: StepContext) -> Well | None:
    """Fill up the well if needed, then dip. Return how the well was; None without an ink device."""
    run, well = context.run, None
    with run.progress.meanwhile("dip"):
        if run.rig.ink is not None:
            well = await run.rig.ink.replenish(run.dips)
            run.dips += 1
            context.recorder.ink(well.level, well.dosed_ml, run.light)
        await context.guard.guarded(run.procedures.dip())
        run.left_ink_ns = run.rig.clock.now_ns()
    return well


async def set_light(run: RunContext) -> None:
    """Set the light of the ink device, once per run. Raises `DeviceError`."""
    if run.rig.ink is not None:
        run.light = await run.rig.ink.light()


def must_dip(context: StepContext) -> bool:
    """Whether the brush must dip before it may press: it is not known to hold ink, or the ink has waited too long."""
    left_ns = context.run.left_ink_ns
    return left_ns is None or context.run.rig.clock.now_ns() - left_ns > STALE_INK_S * 1e9


class DipToTouch:
    """Times from dip to touch within one step: one for a press, one or more for a figure that dips between strokes."""

    def __init__(self, context: StepContext) -> None:
        self._context = context
        self._left_ns: int | None = None
        self._waits_s: list[float] = []

    @property
    def longest_s(self) -> float | None:
        """The longest time; None if no pose showed the brush on the paper."""
        return max(self._waits_s, default=None)

    @contextmanager
    def watching(self) -> Generator[DipToTouch]:
        """Within the block, look at every pose."""
        with self._context.recorder.also(self._pose):
            yield self

    async def begin(self, first: Move) -> None:
        """Start timing a stroke that begins with the move `first`; wait above the patch if the protocol asks for a
        fixed time after the dip."""
        run = self._context.run
        left_ns, run.left_ink_ns = run.left_ink_ns, None
        assert left_ns is not None
        if (wait_s := run.protocol.wait_after_dip_s) is not None:
            await run.procedures.go(first)
            left_s = wait_s - (run.rig.clock.now_ns() - left_ns) / 1e9
            with run.progress.meanwhile(f"wait with the ink, {wait_s:g} s from the dip"):
                await asyncio.sleep(max(left_s, 0.0))
        self._left_ns = left_ns

    def _pose(self, sample: PoseSample) -> None:
        # The first pose on the paper counts; the step's moves come down nowhere else before it.
        if self._left_ns is None:
            return
        procedures, paper = self._context.run.procedures, self._context.run.rig.config.paper
        if procedures.plane.above_mm(paper, sample.pose) <= TOUCH_TOLERANCE_MM:
            self._waits_s.append((sample.stamp.host_ns - self._left_ns) / 1e9)
            self._left_ns = None


async def press(context: StepContext, step: PressStep) -> PressResult:
    """The PRESS step."""
    patch, procedures = await _ready(context), context.run.procedures
    down, _ = press_moves(context.run.rig.config, procedures.plane, patch, step.press.condition)
    with DipToTouch(context).watching() as timing:
        await timing.begin(down[0])
        pressing = procedures.press(patch, step.press.condition, step.dwell_s)
        reached_mm = await context.guard.guarded(pressing)
    pressed = _as_made(context, step.press, reached_mm, timing)
    return PressResult(press=pressed, peak_force_n=_peak_n(context, context.guard.peak_n))


async def draw(context: StepContext, step: DrawStep) -> PressResult:
    """The DRAW step: every stroke of a figure, with dips in between if the protocol asks for them."""
    run, drawn = context.run, step.drawn
    patch = await _ready(context)
    plane = run.procedures.plane
    config = run.rig.config
    await within_limits(check_step, "", config, plane, step, [patch])
    depths_mm: list[float] = []
    peaks_n: list[float] = []
    with DipToTouch(context).watching() as timing:
        for number, points in enumerate(drawn.strokes):
            if drawn.dips_before(number):
                await fill_brush(context)
            if run.left_ink_ns is not None:
                first, *_ = stroke_moves(config, plane, patch, points, drawn.speed_mm_s)
                assert isinstance(first, Move)
                await timing.begin(first)
            depths_mm.append(await context.guard.guarded(run.procedures.stroke(patch, drawn, number)))
            peaks_n.append(context.guard.peak_n)
    pressed = _as_made(context, step.press, max(depths_mm), timing)
    return PressResult(
        kind=StepKind.DRAW, press=pressed, peak_force_n=_peak_n(context, max(peaks_n)), depths_mm=tuple(depths_mm)
    )


async def _ready(context: StepContext) -> Patch:
    """Check the sheet, fill the brush if its ink is old, and return the patch to press, which was seen to be blank."""
    [patch] = context.patches
    await look_at_sheet(context)
    if must_dip(context):
        # Resumed, paused, or the last press failed: the brush may have dried or lost its ink since its dip.
        context.recorder.log("dip again before the press")
        await fill_brush(context)
    return patch


def _as_made(context: StepContext, press: Press, reached_mm: float, timing: DipToTouch) -> Press:
    """The press with its place, and what was measured of it."""
    [patch] = context.patches
    wait_s = None if timing.longest_s is None else round(timing.longest_s, 3)
    place = {"sheet": context.run.store.state.sheet, "patch": patch.index}
    return press.model_copy(update={**place, "reached_mm": reached_mm, "dip_to_touch_s": wait_s})


def _peak_n(context: StepContext, peak_n: float) -> float | None:
    return None if context.run.rig.force is None else peak_n
