"""Finds the paper: what every run sets anew, zero touch, single touches of a calibration, and the self-check."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from collect.engine.steps.context import Bench, Job
from collect.engine.steps.dip import fill_brush
from collect.errors import ConfigError, StepError
from collect.motion.touches import visit_moves
from collect.operator.questions import Choice, Prompt
from collect.planning.limits import check_poses, check_step
from collect.planning.moves import touch_of
from collect.protocols.steps import Result
from collect.rig.config_touch import TouchConfig
from collect.rig.plane import PaperPlane
from collect.touch.jog import asked
from collect.touch.measure import measure_plane
from collect.touch.results import PlaneResult, kept
from collect.touch.selfcheck import self_check, triangle_on
from collect.touch.tap import ForceTap
from drivers.samples import Frame
from sessions.recording.messages import Transform


async def zero_touch(job: Job) -> Result:
    """The ZERO_TOUCH step: light, force bias, the plane, and that every planned pose still lies within the limits."""
    bench = job.bench
    rig = bench.rig
    await bench.inking.begin()
    if rig.force is not None and rig.config.force is not None:
        await rig.force.bias(rig.config.force.bias_s)
    if job.step.params.get("method") == "kept":
        found = kept(bench.procedures.plane, rig.config.paper.touch_point_mm)
    else:
        if "method" in job.step.params:
            await _check(check_step, "", rig.config, bench.procedures.plane, job.step)
        found = await _measured(job, touch_of(rig.config, job.step))
    await _check(check_poses, "over the paper as it was touched, ", rig.config, bench.protocol, found.plane)
    moved_mm = _moved_mm(found, bench.procedures.plane)
    if found.method == "kept":
        bench.progress.log(f"zero touch was given up: {_height(bench)} is kept", warning=True)
    elif found.method != "taught":
        bench.progress.log(f"zero touch by {found.method}: the paper lies {moved_mm:+.2f} mm from where it was before")
    if job.step.params.get("between_strokes"):
        await _accepted(job, moved_mm)
    bench.procedures.plane = found.plane
    origin_mm, quaternion = found.plane.frame(rig.config.paper)
    job.recorder.frames([Transform("base", "paper", origin_mm, quaternion)])
    if (optics := rig.config.camera.optics) is not None:
        job.recorder.optics(optics)
    return {**found.as_dict(), "moved_mm": moved_mm}


def _moved_mm(found: PlaneResult, before: PaperPlane) -> float:
    """How far the paper was found above where it was thought to lie, at the touched point where that is most."""
    away = [point.mean[2] - before.touch_z_mm(point.mean[0], point.mean[1]) for point in found.points]
    return max(away, key=abs)


async def _accepted(job: Job, moved_mm: float) -> None:
    """A person looks before strokes are pressed from another height than those before. Raises `StepError`."""
    words = f"The paper was found {moved_mm:+.2f} mm from where it was. Strokes from here on are pressed from there."
    choices = (Choice("g", "good, go on from the new height"), Choice("k", "keep the height as it was"))
    if await job.bench.asker.ask(Prompt(words, choices, "k")) != "g":
        raise StepError("what was found was not taken.")


async def touch(job: Job) -> Result:
    """The TOUCH step: one point, by the method of the rig."""
    bench = job.bench
    config = touch_of(bench.rig.config, job.step)
    if config.method == "taught":
        [point] = config.points_mm
        z_mm = await job.guard.guarded(_visited(bench, point))
        return {"x_mm": point[0], "y_mm": point[1], "z_mm": z_mm, "method": "taught"}
    found = await _measured(job, config)
    x_mm, y_mm, z_mm = found.points[0].mean
    return {"x_mm": x_mm, "y_mm": y_mm, "z_mm": z_mm, "span_mm": found.points[0].span_mm, "method": found.method}


async def _visited(bench: Bench, point: tuple[float, float]) -> float:
    """The height at which the arm rests where the surface is thought to be."""
    *down, up = visit_moves(bench.rig.config, bench.procedures.plane, *point)
    for move in down:
        await bench.procedures.go(move)
    z_mm = (await bench.rig.robot.where()).z_mm
    await bench.procedures.go(up)
    return z_mm


async def check_rig(job: Job) -> Result:
    """The SELF_CHECK step: an uneven triangle on cells of its own tells a mirrored, turned or stretched rig."""
    bench, cell = job.bench, job.cell
    assert cell is not None
    cells = (cell, *job.more_cells)
    places_mm = triangle_on(cells, bench.rig.config.self_check)
    checked = await job.guard.guarded(self_check(bench.rig, _Hands(job), places_mm, bench.procedures.plane))
    marked = {"sheet": bench.store.state.sheet, "cell": cell.index, "cells": [one.index for one in cells]}
    return {**checked.as_dict(), **marked}


class _Hands:
    """What touches and self-check ask of the rig's procedures; a dip keeps the well filled."""

    def __init__(self, job: Job) -> None:
        self._job = job

    async def zero_touch(self) -> float:
        """Visit the taught height."""
        return await self._job.bench.procedures.zero_touch()

    async def dip(self) -> None:
        """Into the well and out again; the touch that follows takes ink, so no press may count on this dip."""
        await fill_brush(self._job)
        self._job.bench.known.left_ink_ns = None

    async def capture(self) -> Frame:
        """Park, and a fresh frame."""
        return await self._job.bench.procedures.capture()


async def _measured(job: Job, config: TouchConfig) -> PlaneResult:
    bench = job.bench
    tap = ForceTap()
    with job.guard.also(tap.take):
        jog = asked(bench.asker, config.jog, _height(bench))

        def tell(words: str) -> None:
            bench.progress.doing(f"zero touch by {config.method}: {words}")

        measured = measure_plane(bench.rig, _Hands(job), config, tap=tap, next_jog=jog, tell=tell)
        return await job.guard.guarded(measured)


def _height(bench: Bench) -> str:
    """The height that is known without a measurement, in words."""
    paper, plane = bench.rig.config.paper, bench.procedures.plane
    how = "taught height" if plane == PaperPlane(paper.touch_z_mm) else "height that was measured before"
    return f"the {how}, {plane.touch_z_mm(*paper.touch_point_mm):.2f} mm,"


async def _check(check: Callable[..., None], where: str, *checked: object) -> None:
    try:
        # Seconds for a long protocol: beside the loop, so that a stop is heard meanwhile.
        await asyncio.to_thread(check, Path("rig.toml"), *checked)
    except ConfigError as error:
        raise StepError(f"{where}{error.what}") from None
