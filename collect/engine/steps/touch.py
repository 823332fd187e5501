"""Steps that find the paper: zero touch, single touches of a calibration, and the self-check."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from brushloop.collect.engine.steps.context import RunContext, StepContext
from brushloop.collect.engine.steps.dip import fill_brush, set_light
from brushloop.collect.errors import ConfigError, StepError
from brushloop.collect.motion.moves import visit_moves
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.planning.limit_check import check_poses, check_step
from brushloop.collect.planning.walk import touch_of
from brushloop.collect.protocols.steps import TouchStep, ZeroTouchStep
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.touch.arm import ForceTap
from brushloop.collect.touch.heights import PlaneResult, kept
from brushloop.collect.touch.measure import asked, measure_plane
from brushloop.collect.touch.selfcheck import self_check, triangle_on
from brushloop.drivers.devices import Frame
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
        found = kept(run.procedures.plane, rig.config.paper.touch_point_mm)
    else:
        if step.method is not None:
            await _check(check_step, "", rig.config, run.procedures.plane, step)
        found = await _measured(context, touch_of(rig.config, step))
    await _check(check_poses, "over the paper as it was touched, ", rig.config, run.protocol, found.plane)
    moved_mm = _moved_mm(found, run.procedures.plane)
    if found.method == "kept":
        run.progress.log(f"zero touch was given up: {_height(run)} is kept", warning=True)
    elif found.method != "taught":
        run.progress.log(f"zero touch by {found.method}: {_compared(moved_mm, found.plane, run.procedures.plane)}")
    if step.between_strokes:
        await _accepted(context, moved_mm)
    run.procedures.plane = found.plane
    origin_mm, quaternion = found.plane.frame(rig.config.paper)
    context.recorder.paper(origin_mm, quaternion)
    if (optics := rig.config.camera.optics) is not None:
        context.recorder.optics(optics)
    return found.result(moved_mm)


def _moved_mm(found: PlaneResult, before: PaperPlane) -> float:
    """How far the paper lies above where it was before, at the touched point where it moved most."""
    away = [point.mean[2] - before.touch_z_mm(point.mean[0], point.mean[1]) for point in found.points]
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
        [point] = config.points_mm
        z_mm = await context.guard.guarded(_visited(run, point))
        return TouchResult(method="taught", x_mm=point[0], y_mm=point[1], z_mm=z_mm)
    found = await _measured(context, config)
    x_mm, y_mm, z_mm = found.points[0].mean
    return TouchResult(method=found.method, x_mm=x_mm, y_mm=y_mm, z_mm=z_mm, span_mm=found.points[0].span_mm)


async def _visited(run: RunContext, point: tuple[float, float]) -> float:
    """Move to where the surface should be, and return the height at which the arm rests there."""
    *down, up = visit_moves(run.rig.config, run.procedures.plane, *point)
    for move in down:
        await run.procedures.go(move)
    z_mm = (await run.rig.robot.where()).z_mm
    await run.procedures.go(up)
    return z_mm


async def check_rig(context: StepContext) -> SelfCheckResult:
    """The SELF_CHECK step: a scalene triangle of marks shows whether the rig is mirrored, turned or stretched."""
    run, patch = context.run, context.patch
    assert patch is not None
    patches = (patch, *context.more_patches)
    places_mm = triangle_on(patches, run.rig.config.self_check)
    checked = await context.guard.guarded(self_check(run.rig, _Effector(context), places_mm, run.procedures.plane))
    on = {"sheet": run.store.state.sheet, "patches": tuple(one.index for one in patches)}
    return checked.model_copy(update=on)


class _Effector:
    """The rig's procedures as touches and the self-check use them; a dip also keeps the well filled."""

    def __init__(self, context: StepContext) -> None:
        self._context = context

    async def zero_touch(self) -> float:
        """Visit the taught height."""
        return await self._context.run.procedures.zero_touch()

    async def dip(self) -> None:
        """Fill the brush. The touch that follows takes ink, so the next press must dip again."""
        await fill_brush(self._context)
        self._context.run.left_ink_ns = None

    async def capture(self) -> Frame:
        """Park, and take a fresh frame."""
        return await self._context.run.procedures.capture()


async def _measured(context: StepContext, config: TouchConfig) -> PlaneResult:
    run = context.run
    tap = ForceTap()
    with context.guard.also(tap.take):
        jog = asked(run.asker, config.jog, _height(run))

        def tell(doing: str) -> None:
            run.progress.doing(f"zero touch by {config.method}: {doing}")

        measured = measure_plane(run.rig, _Effector(context), config, tap=tap, next_jog=jog, tell=tell)
        return await context.guard.guarded(measured)


def _height(run: RunContext) -> str:
    """The height that is known without a new measurement, in words."""
    paper, plane = run.rig.config.paper, run.procedures.plane
    how = "taught height" if plane == PaperPlane(paper.touch_z_mm) else "height that was measured before"
    return f"the {how}, {plane.touch_z_mm(*paper.touch_point_mm):.2f} mm,"


async def _check(check: Callable[..., None], where: str, *checked: object) -> None:
    try:
        # Takes seconds for a long protocol; runs in a thread, so that a stop takes effect meanwhile.
        await asyncio.to_thread(check, Path("rig.toml"), *checked)
    except ConfigError as error:
        raise StepError(f"{where}{error.what}") from None
