"""Steps in which the brush goes down, into ink or onto paper: dip, press, figure, zero touch, touch, self-check."""

from __future__ import annotations

from functools import partial

from brushloop.collect.engine.capture import look_at_sheet
from brushloop.collect.engine.recorder import StepContext, within_limits
from brushloop.collect.errors import StepError
from brushloop.collect.motion import TOUCH_TOLERANCE_MM
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.protocols.steps import DrawStep, PressStep, TouchStep, ZeroTouchStep
from brushloop.collect.rig.config import TouchConfig
from brushloop.collect.rig.paper import PaperPlane, Patch
from brushloop.collect.touch.force import ForceTap
from brushloop.collect.touch.heights import plane_of
from brushloop.collect.touch.measure import measure_plane
from brushloop.collect.touch.selfcheck import self_check, triangle_on
from brushloop.collect.walk import all_poses, step_poses, touch_of
from brushloop.drivers.devices import PoseSample, Well
from brushloop.sessions.events import (
    DipResult,
    Press,
    PressResult,
    SelfCheckResult,
    StepKind,
    TouchResult,
    ZeroTouchResult,
)

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


class DipToTouch:
    """Times from dip to touch within one step: one for a press, one or more for a figure that dips between strokes."""

    def __init__(self, context: StepContext) -> None:
        self._context = context
        self._left_ns: int | None = None
        self._waits_s: list[float] = []
        context.recorder.listeners.append(self._pose)

    @property
    def longest_s(self) -> float | None:
        """The longest time; None if no pose showed the brush on the paper."""
        return max(self._waits_s, default=None)

    def begin(self) -> None:
        """Time the next stroke, from the moment at which the brush left the ink."""
        run = self._context.run
        self._left_ns, run.left_ink_ns = run.left_ink_ns, None

    def _pose(self, sample: PoseSample) -> None:
        """Take a pose: the first one on the paper counts, and the step's moves come down nowhere else before it."""
        if self._left_ns is None:
            return
        procedures, paper = self._context.run.procedures, self._context.run.rig.config.paper
        if procedures.plane.above_mm(paper, sample.pose) <= TOUCH_TOLERANCE_MM:
            self._waits_s.append((sample.stamp.host_ns - self._left_ns) / 1e9)
            self._left_ns = None


async def press(context: StepContext, step: PressStep) -> PressResult:
    """The PRESS step."""
    patch, procedures = await _ready(context), context.run.procedures
    timing = DipToTouch(context)
    timing.begin()
    reached_mm = await context.guard.guarded(procedures.press(patch, step.press.condition, step.dwell_s))
    pressed = _as_made(context, step.press, reached_mm, timing)
    return PressResult(press=pressed, peak_force_n=_peak_n(context, context.guard.peak_n))


async def draw(context: StepContext, step: DrawStep) -> PressResult:
    """The DRAW step: every stroke of a figure, with a dip before each."""
    run, drawn = context.run, step.drawn
    patch = await _ready(context)
    depths_mm: list[float] = []
    peaks_n: list[float] = []
    timing = DipToTouch(context)
    for number in range(len(drawn.strokes)):
        if number > 0:
            await fill_brush(context)
        timing.begin()
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
    run, left_ns = context.run, context.run.left_ink_ns
    if left_ns is None or run.rig.clock.now_ns() - left_ns > STALE_INK_S * 1e9:
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


async def zero_touch(context: StepContext, step: ZeroTouchStep) -> ZeroTouchResult:
    """The ZERO_TOUCH step: set the light, measure the force sensor's bias and the paper's plane, and check that every
    planned pose still lies within the limits."""
    run = context.run
    rig = run.rig
    if rig.ink is not None:
        run.light = await rig.ink.light()
    if rig.force is not None and rig.config.force is not None:
        await rig.force.bias(rig.config.force.bias_s)
    if step.method is not None:
        await within_limits("", rig.config, step_poses(rig.config, run.procedures.plane, step))
    measured = await _measured(context, touch_of(rig.config, step))
    plane = plane_of(measured)
    poses = all_poses(rig.config, run.protocol, plane)
    await within_limits("over the paper as it was touched, ", rig.config, poses)
    moved_mm = _moved_mm(measured, run.procedures.plane)
    if measured.method != "taught":
        run.progress.log(
            f"zero touch by {measured.method}: the paper lies {moved_mm:+.2f} mm from the height known before"
        )
    if step.between_strokes:
        await _accepted(context, moved_mm)
    run.procedures.plane = plane
    origin_mm, quaternion = plane.frame(rig.config.paper)
    context.recorder.paper(origin_mm, quaternion)
    if (optics := rig.config.camera.optics) is not None:
        context.recorder.optics(optics)
    return measured.model_copy(update={"moved_mm": moved_mm})


def _moved_mm(measured: ZeroTouchResult, before: PaperPlane) -> float:
    """How far the paper lies above where it was before, at the touched point where it moved most."""
    away = [point.z_mm - before.touch_z_mm(point.x_mm, point.y_mm) for point in measured.points]
    return max(away, key=abs)


async def _accepted(context: StepContext, moved_mm: float) -> None:
    """Ask a person before strokes are pressed from a new height. Raises `StepError` if the answer is no."""
    text = f"The paper was found {moved_mm:+.2f} mm from where it was. From now on, H is counted from there."
    choices = (Choice("g", "good, use the new height"), Choice("k", "keep the old height"))
    if await context.run.asker.ask(Prompt(text, choices, "k")) != "g":
        raise StepError("the new height was not accepted.")


async def touch(context: StepContext, step: TouchStep) -> TouchResult:
    """The TOUCH step: measure the height of one point, by the method of the rig."""
    run = context.run
    config = touch_of(run.rig.config, step)
    if config.method == "taught":
        visited = run.procedures.visit(run.procedures.plane, step.x_mm, step.y_mm)
        z_mm = await context.guard.guarded(visited)
        return TouchResult(method="taught", x_mm=step.x_mm, y_mm=step.y_mm, z_mm=z_mm)
    measured = await _measured(context, config)
    [point] = measured.points
    return TouchResult(method=measured.method, x_mm=point.x_mm, y_mm=point.y_mm, z_mm=point.z_mm, span_mm=point.span_mm)


async def check_rig(context: StepContext) -> SelfCheckResult:
    """The SELF_CHECK step: a scalene triangle of marks shows whether the rig is mirrored, turned or stretched."""
    run, patches = context.run, context.patches
    places_mm = triangle_on(patches, run.rig.config.self_check)
    checked = await context.guard.guarded(self_check(run.procedures, places_mm, partial(_fill_for_touch, context)))
    place = {"sheet": run.store.state.sheet, "patches": tuple(patch.index for patch in patches)}
    return checked.model_copy(update=place)


async def _fill_for_touch(context: StepContext) -> None:
    """Fill brush and well. The touch that follows takes ink, so the next press must dip again."""
    await fill_brush(context)
    context.run.left_ink_ns = None


async def _measured(context: StepContext, config: TouchConfig) -> ZeroTouchResult:
    run = context.run
    tap = ForceTap()
    context.guard.listeners.append(tap.take)

    def tell(doing: str) -> None:
        run.progress.doing(f"zero touch by {config.method}: {doing}")

    dip = partial(_fill_for_touch, context)
    measured = measure_plane(run.procedures, config, dip=dip, tap=tap, asker=run.asker, tell=tell)
    return await context.guard.guarded(measured)
