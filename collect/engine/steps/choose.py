"""Chooses the next press of an adaptive protocol from the ink of the presses before it; nothing moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibrate.errors import CaptureRefused
from calibrate.stroke.params import Gray, Params
from calibrate.stroke.preprocess import prepare
from collect.engine.last_capture import cell_raster
from collect.engine.steps.context import RunContext, StepContext, uninterrupted
from collect.protocols.adaptive import AdaptiveConfig
from collect.protocols.steps import Result, StepKind
from collect.rig.paper import Cell

if TYPE_CHECKING:
    from calibrate.fit.stepwise import CapturedPress, Next


async def choose(context: StepContext) -> Result:
    """The CHOOSE step: `height_mm` and `tilt_deg` of the next press, or `stop` with the number of presses saved.

    The choice depends only on the captures in the journal, so a killed run chooses the same press again.
    """
    run, protocol = context.run, context.run.protocol
    assert isinstance(protocol, AdaptiveConfig)
    seen = _seen(run)
    with context.recorder.sections.timed("fit the brush"):
        found = await uninterrupted(_fitted, run, protocol, seen)
    result: Result = {
        "number": context.step.index,
        "points": round(found.points, 4),
        "points_after": round(found.points_after, 4),
        "strokes": found.strokes,
        "ink_sha256": found.ink_sha256,
        "why": found.why,
    }
    if found.cell is not None and not context.step.params.get("last"):
        height_mm, tilt_deg = found.cell
        run.progress.log(f"next H = {height_mm:g} mm, alpha = {tilt_deg:g} deg: {found.why}")
        return {**result, "stop": False, "height_mm": height_mm, "tilt_deg": tilt_deg}
    pressed = context.step.index
    saved = max(0, protocol.whole_grid - pressed)
    why = found.why if found.cell is None else f"most_presses is reached; {found.points:.2f} points could be gained"
    run.progress.log(
        f"stopped choosing after {pressed} presses: {why}. "
        f"{saved} of the {protocol.whole_grid} presses of the shuffled grid were saved"
    )
    return {**result, "stop": True, "why": why, "saved": saved}


async def measured(context: StepContext, image: Gray, cell: Cell) -> Result:
    """The ink of a captured press, packed for the journal; empty if no whole stroke is seen."""
    with context.recorder.sections.timed("measure the ink"):
        ink, why = await uninterrupted(_ink, context.run, image, cell)
    if why:
        stroke_id = context.step.params["stroke_id"]
        context.run.progress.log(f"{stroke_id}: not used for the choice: {why}", warning=True)
    return {"ink": ink}


def _seen(run: RunContext) -> list[CapturedPress]:
    """Ink of the captures so far, in the order in which they were made, without those that were retaken."""
    from calibrate.fit.stepwise import CapturedPress

    results = [line["result"] for line in run.store.state.segments if line["kind"] == StepKind.CAPTURE]
    return [
        CapturedPress(float(r["height_mm"]), float(r["tilt_deg"]), str(r.get("ink", "")) if r["kept"] else "")
        for r in results
        if not r["retake"]
    ]


def _fitted(run: RunContext, protocol: AdaptiveConfig, seen: list[CapturedPress]) -> Next:
    from calibrate.fit.stepwise import Design, next_cell

    brush = run.rig.config.brush
    design = Design(
        brush.radius_mm,
        brush.length_mm,
        tuple(protocol.cells),
        protocol.enough_points,
        protocol.least_presses,
    )
    return next_cell(design, seen)


def _ink(run: RunContext, image: Gray, cell: Cell) -> tuple[str, str]:
    """Return (packed ink, why there is none)."""
    from calibrate.fit.stepwise import packed

    try:
        raster, anchor_px, cell_px = cell_raster(image, run.image_plane(image), cell)
        prepared = prepare(raster, anchor_px, "the capture", Params(), cell_px)
    except CaptureRefused as error:
        return "", error.what
    return ("", "is cut by the edge of its cell") if prepared.cut else (packed(prepared.mask), "")
