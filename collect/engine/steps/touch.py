"""Steps that find the paper: zero touch, single touches of a calibration, and the self-check."""

from __future__ import annotations

from functools import partial

from brushloop.collect.engine.steps.context import RunContext, StepContext, within_limits
from brushloop.collect.engine.steps.press import fill_brush, set_light
from brushloop.collect.errors import StepError
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.planning.limit_check import check_poses, check_step
from brushloop.collect.planning.walk import touch_of
from brushloop.collect.protocols.steps import TouchStep, ZeroTouchStep
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.touch.force import ForceTap
from brushloop.collect.touch.heights import PlaneResult, kept
from brushloop.collect.touch.measure import asked, measure_plane
from brushloop.collect.touch.selfcheck import self_check, triangle_on
from brushloop.sessions.events import SelfCheckResult, TouchResult, ZeroTouchResult


async def zero_touch(context: StepContext, step: ZeroTouchStep) -> ZeroTouchResult:
    """The ZERO_TOUCH step: set the light, measure the force sensor's bias and the paper's plane, and check that every
    planned pose still lies within the limits."""
    run = context.run
    rig = run.rig
    await set_light(run)
    if rig.force is not None and rig.config.force is not None:
        await rig.force.bias(rig.config.force.bias_s)
    if step.method == "kept":
        measured = kept(run.procedures.plane, rig.config.paper.touch_point_mm)
    else:
        if step.method is not None:
            await within_limits(check_step, "", rig.config, run.procedures.plane, step)
        measured = await _measured(context, touch_of(rig.config, step))
    await within_limits(check_poses, "over the paper as it was touched, ", rig.config, run.protocol, measured.plane)
    moved_mm = _moved_mm(measured, run.procedures.plane)
    if measured.method == "kept":
        run.progress.log(f"zero touch was given up: {_height(run)} is kept", warning=True)
    elif measured.method != "taught":
        run.progress.log(
            f"zero touch by {measured.method}: {_compared(moved_mm, measured.plane, run.procedures.plane)}"
        )
    if step.between_strokes:
        await _accepted(context, moved_mm)
    run.procedures.plane = measured.plane
    origin_mm, quaternion = measured.plane.frame(rig.config.paper)
    context.recorder.paper(origin_mm, quaternion)
    if (optics := rig.config.camera.optics) is not None:
        context.recorder.optics(optics)
    return measured.result(moved_mm)


def _moved_mm(measured: PlaneResult, before: PaperPlane) -> float:
    """How far the paper lies above where it was before, at the touched point where it moved most."""
    away = [point.mean[2] - before.touch_z_mm(point.mean[0], point.mean[1]) for point in measured.points]
    return max(away, key=abs)


def _compared(moved_mm: float, now: PaperPlane, before: PaperPlane) -> str:
    if before.slope_deg == 0.0 < now.slope_deg:  # rig.toml has one height for the whole sheet
        return f"the paper differs by up to {moved_mm:+.2f} mm from a level sheet at the height known before"
    return f"the paper lies {moved_mm:+.2f} mm from where it was before"


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
    x_mm, y_mm, z_mm = measured.points[0].mean
    return TouchResult(method=measured.method, x_mm=x_mm, y_mm=y_mm, z_mm=z_mm, span_mm=measured.points[0].span_mm)


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


async def _measured(context: StepContext, config: TouchConfig) -> PlaneResult:
    run = context.run
    tap = ForceTap()
    with context.guard.also(tap.take):
        jog = asked(run.asker, config.jog, _height(run))

        def tell(doing: str) -> None:
            run.progress.doing(f"zero touch by {config.method}: {doing}")

        dip = partial(_fill_for_touch, context)
        measured = measure_plane(run.procedures, config, dip=dip, tap=tap, next_jog=jog, tell=tell)
        return await context.guard.guarded(measured)


def _height(run: RunContext) -> str:
    """The height that is known without a new measurement, in words."""
    paper, plane = run.rig.config.paper, run.procedures.plane
    how = "taught height" if plane == PaperPlane(paper.touch_z_mm) else "height that was measured before"
    return f"the {how}, {plane.touch_z_mm(*paper.touch_point_mm):.2f} mm,"
