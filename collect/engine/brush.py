"""Steps in which the brush goes down, into ink or onto paper: dip, press, figure, zero touch, self-check."""

from __future__ import annotations

from functools import partial

from brushloop.collect.engine.capture import look_at_sheet
from brushloop.collect.engine.recorder import StepContext, within_limits
from brushloop.collect.errors import StepError
from brushloop.collect.motion import TOUCH_TOLERANCE_MM
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.protocols.steps import PressStep, ZeroTouchStep
from brushloop.collect.touch.force import average
from brushloop.collect.touch.heights import plane_of
from brushloop.collect.touch.measure import measure_plane
from brushloop.collect.touch.selfcheck import self_check, triangle_on
from brushloop.collect.walk import all_poses, step_poses, touch_of
from brushloop.drivers.devices import PoseSample
from brushloop.sessions.events import DipResult, PressResult, SelfCheckResult, ZeroTouchResult
from brushloop.sessions.records import InkState, Topic

STALE_INK_S = 5.0
"""After a longer wait (a pause, a question, a photograph) the brush dips again before it presses."""


async def dip(context: StepContext) -> DipResult:
    """The DIP step. Looks at the sheet first, so that the filled brush does not wait for it."""
    await look_at_sheet(context)
    return await fill_brush(context)


async def fill_brush(context: StepContext) -> DipResult:
    """Fill up the well if needed, then dip. The result says how the well was, if there is an ink device."""
    run, device, dipped = context.run, context.run.rig.ink, DipResult()
    with run.progress.meanwhile("dip"):
        if device is not None:
            level = await device.replenish()
            ink = InkState(level=level, dosed_ml=device.dosed_ml, light=run.light)
            context.recorder.event(Topic.INK, ink)
            dipped = DipResult(ink_level=ink.level, dosed_ml=ink.dosed_ml)
        await context.guard.guarded(run.procedures.dip())
        run.left_ink_ns = run.rig.clock.now_ns()
    return dipped


async def mark(context: StepContext, step: PressStep) -> PressResult:
    """The PRESS step: one press, or every stroke of a figure, with a dip before each."""
    run, [patch], drawn = context.run, context.patches, step.drawn
    procedures, paper = run.procedures, run.rig.config.paper
    left_ns: int | None = None
    waits_s: list[float] = []
    depths_mm: list[float] = []
    peaks_n: list[float] = []

    def touched(sample: PoseSample) -> None:
        """Note the time from the ink to the first pose on the paper: no move of the step comes down before it."""
        nonlocal left_ns
        if left_ns is not None and procedures.plane.above_mm(paper, sample.pose) <= TOUCH_TOLERANCE_MM:
            waits_s.append((sample.stamp.host_ns - left_ns) / 1e9)
            left_ns = None

    await look_at_sheet(context)
    if run.left_ink_ns is None or run.rig.clock.now_ns() - run.left_ink_ns > STALE_INK_S * 1e9:
        # Resumed, paused, or the last press failed: the brush may have dried or lost its ink since its dip.
        context.recorder.log("the brush may be dry: dip again before the press")
        await fill_brush(context)
    context.recorder.listeners.append(touched)
    for number in range(1 if drawn is None else len(drawn.strokes)):
        if number > 0:
            await fill_brush(context)
        left_ns = run.left_ink_ns
        if drawn is None:
            stroke = procedures.press(patch, step.press.condition, step.dwell_s)
        else:
            stroke = procedures.stroke(patch, drawn, number)
        depths_mm.append(await context.guard.guarded(stroke))
        peaks_n.append(context.guard.peak_n)
    made = {
        "sheet": run.store.state.sheet,
        "patch": patch.index,
        "reached_mm": max(depths_mm),
        "dip_to_touch_s": round(max(waits_s), 3) if waits_s else None,
    }
    return PressResult(
        press=step.press.model_copy(update=made),
        peak_force_n=None if run.rig.force is None else max(peaks_n),
        depths_mm=() if drawn is None else tuple(depths_mm),
    )


async def zero_touch(context: StepContext, step: ZeroTouchStep) -> ZeroTouchResult:
    """The ZERO_TOUCH step: set the light, measure the force sensor's bias and the paper's plane, and check that every
    planned pose still lies within the limits. Between strokes a person is asked before they are pressed from the new
    height. Raises `StepError` if the answer is no."""
    run = context.run
    rig = run.rig
    if rig.ink is not None:
        run.light = await rig.ink.light()
    if rig.force is not None and rig.config.force is not None:
        await rig.force.bias(rig.config.force.bias_s)
        run.progress.zeroed(rig.config.force.max_n)
    if step.method is not None:
        await within_limits("", rig.config, step_poses(rig.config, run.procedures.plane, step))
    touch = touch_of(rig.config, step)

    dip, push = partial(fill_brush, context), partial(average, context.guard.listeners)
    tell = run.progress.doing
    measuring = measure_plane(run.procedures, touch, dip=dip, average=push, asker=run.asker, tell=tell)
    measured = await context.guard.guarded(measuring)
    plane = plane_of(measured)
    poses = all_poses(rig.config, run.opening.protocol, plane)
    await within_limits("over the paper as it was touched, ", rig.config, poses)
    # How far the paper lies above where it was before, at the touched point where it moved most.
    before = run.procedures.plane
    moved_mm = max((p.z_mm - before.touch_z_mm(p.x_mm, p.y_mm) for p in measured.points), key=abs)
    if step.index == 0 and before.slope_deg == 0.0:
        # Only the height at one point was known: elsewhere, a lean would look like a move.
        moved_mm = plane.touch_z_mm(*rig.config.paper.touch_point_mm) - before.z0_mm
    if measured.method != "taught":
        run.progress.log(
            f"zero touch by {measured.method}: the paper leans by {measured.slope_deg:.2f} deg, and lies "
            f"{moved_mm:+.2f} mm from the height that was known before"
        )
    if step.index > 0:
        text = f"You found the paper {moved_mm:+.2f} mm from its earlier height. Shall H count from the new height?"
        choices = (Choice("g", "good, use the new height"), Choice("k", "keep the old height"))
        if await run.asker.ask(Prompt(text, choices, "k")) != "g":
            raise StepError("the new height was not accepted.")
    run.procedures.plane = plane
    context.recorder.paper(*plane.frame(rig.config.paper))
    if (optics := rig.config.camera.optics) is not None:
        context.recorder.optics(optics)
    return measured.model_copy(update={"moved_mm": moved_mm})


async def check_rig(context: StepContext) -> SelfCheckResult:
    """The SELF_CHECK step: a scalene triangle of marks shows whether the rig is mirrored, turned or stretched."""
    run, patches = context.run, context.patches
    places_mm = triangle_on(patches)
    checked = await context.guard.guarded(self_check(run.procedures, places_mm, partial(fill_brush, context)))
    place = {"sheet": run.store.state.sheet, "patches": tuple(patch.index for patch in patches)}
    return checked.model_copy(update=place)
