"""Chooses the next press of an adaptive protocol from the ink of those before; nothing moves meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING

from collect.engine.steps.context import RunContext, StepContext
from collect.engine.steps.look import Gray, image_plane
from collect.engine.steps.waiting import uninterrupted
from collect.protocols.adaptive import cells
from collect.protocols.config import AdaptiveConfig
from collect.protocols.steps import Result, StepKind
from collect.rig.paper import Cell

if TYPE_CHECKING:
    from calibrate.fit.stepwise import Next, Seen


async def choose(context: StepContext) -> Result:
    """The CHOOSE step: `height_mm` and `tilt_deg` of the next press, or `stop` with what that saved.

    A function of the captures in the journal alone, so that after a kill the same press is chosen.
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
    why = found.why if found.cell is None else f"most_presses is reached; {found.points:.2f} points are left to be won"
    run.progress.log(
        f"stopped choosing after {pressed} presses: {why}. "
        f"{saved} of the {protocol.whole_grid} presses of the shuffled grid were saved"
    )
    return {**result, "stop": True, "why": why, "saved": saved}


async def measured(context: StepContext, image: Gray, cell: Cell) -> Result:
    """The ink of a captured press as the journal holds it; empty where no whole stroke is seen."""
    with context.recorder.sections.timed("measure the ink"):
        ink, why = await uninterrupted(_ink, context.run, image, cell)
    if why:
        context.run.progress.log(f"{context.step.params['stroke_id']}: not used for the choice: {why}", warning=True)
    return {"ink": ink}


def _seen(run: RunContext) -> list[Seen]:
    """What the captures showed, in the order in which they were made; takes that were made again do not count."""
    from calibrate.fit.stepwise import Seen

    results = [line["result"] for line in run.store.state.segments if line["kind"] == StepKind.CAPTURE]
    return [
        Seen(float(r["height_mm"]), float(r["tilt_deg"]), str(r.get("ink", "")) if r["kept"] else "")
        for r in results
        if not r["retake"]
    ]


def _fitted(run: RunContext, protocol: AdaptiveConfig, seen: list[Seen]) -> Next:
    from calibrate.fit.stepwise import Design, next_cell

    brush = run.rig.config.brush
    design = Design(
        brush.radius_mm,
        brush.length_mm,
        tuple(cells(protocol)),
        protocol.enough_points,
        protocol.least_presses,
    )
    return next_cell(design, seen)


def _ink(run: RunContext, image: Gray, cell: Cell) -> tuple[str, str]:
    from calibrate.errors import CaptureRefused
    from calibrate.fit.stepwise import FIELD, packed
    from calibrate.stroke.preprocess import PX_PER_MM, Params, prepare, rectify

    window = FIELD.window_mm(cell.anchor_mm)
    left, top = (mm * PX_PER_MM for mm in FIELD.anchor_mm)
    top_of_cell = window[1] + window[3] - (cell.y_mm + cell.height_mm)
    x, y, width, height = (
        round(mm * PX_PER_MM) for mm in (cell.x_mm - window[0], top_of_cell, cell.width_mm, cell.height_mm)
    )
    try:
        raster = rectify(image, image_plane(run, image).image_to_paper, window)
        prepared = prepare(raster, (left, top), "the capture", Params(), (x, y, width, height))
    except CaptureRefused as error:
        return "", error.what
    return ("", "is cut by the edge of its cell") if prepared.cut else (packed(prepared.mask), "")
