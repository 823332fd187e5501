"""The steps that every protocol with strokes has: touch, board, then dip, mark and capture each stroke."""

from __future__ import annotations

import itertools
import json
from collections.abc import Generator, Iterable

from collect.protocols.config import WriteConfig
from collect.protocols.planned import Planned
from collect.protocols.rows import TrajectoryPoint
from collect.protocols.steps import Params, Protocol, Result, Step, StepKind


def stroke_steps(plan: Iterable[Planned], *, board_every: int | None, write: WriteConfig | None = None) -> Protocol:
    """Zero touch, board, then dip, press or draw, capture for each stroke of the plan."""
    yield Step(StepKind.ZERO_TOUCH, 0)
    yield Step(StepKind.BOARD, 0)
    for number, stroke in enumerate(plan):
        if board_every is not None and number > 0 and number % board_every == 0:
            yield Step(StepKind.BOARD, number // board_every)
        yield from takes(stroke, write=write)


def takes(
    stroke: Planned, *, write: WriteConfig | None = None, measured: bool = False
) -> Generator[Step, Result, None]:
    """Dip, press or draw, capture; again where the capture says so. `measured`: the capture also tells the ink."""
    for take in itertools.count(1):
        # Only a second take has a number: the keys of first ones are those of older sessions.
        taken: Params = {} if take == 1 else {"take": take}
        dipped = yield Step(StepKind.DIP, stroke.index, taken)
        if dipped.get("skipped"):
            break
        if stroke.figure is None:
            marked = yield Step(StepKind.PRESS, stroke.index, _press_params(stroke) | taken)
        else:
            assert write is not None
            marked = yield Step(StepKind.DRAW, stroke.index, _draw_params(stroke, write) | taken)
        # A capture belongs to one cell: made again elsewhere, it is another step.
        place = _capture_params(stroke, int(marked["sheet"]), int(marked["cell"]))
        if measured:
            place["measured"] = True
        seen = yield Step(StepKind.CAPTURE, stroke.index, place | taken)
        if not seen.get("retake"):
            break


def strokes_text(strokes: Iterable[Iterable[TrajectoryPoint]]) -> str:
    """Trajectories as a step's parameter holds them: JSON, [stroke][point][x, y, height, tilt, heading]."""
    return json.dumps([[list(point) for point in stroke] for stroke in strokes], separators=(",", ":"))


def strokes_of(text: str) -> list[list[TrajectoryPoint]]:
    """The inverse of `strokes_text`. Raises ValueError for anything else."""
    try:
        return [
            [(float(x), float(y), float(h), float(t), float(d)) for x, y, h, t, d in stroke]
            for stroke in json.loads(text)
        ]
    except TypeError as error:
        raise ValueError(f"no trajectories: {error}") from None


def _press_params(stroke: Planned) -> Params:
    params: Params = {
        "stroke_id": stroke.stroke_id,
        "height_mm": stroke.height_mm,
        "tilt_deg": stroke.tilt_deg,
        "dwell_s": stroke.dwell_s,
    }
    return params if stroke.again_of is None else {**params, "again_of": stroke.again_of}


def _draw_params(stroke: Planned, config: WriteConfig) -> Params:
    assert stroke.figure is not None
    return {
        "stroke_id": stroke.stroke_id,
        "height_mm": stroke.height_mm,
        "tilt_deg": stroke.tilt_deg,
        "strokes": strokes_text(drawn.points for drawn in stroke.figure.strokes),
        "cell_w_mm": config.cell_mm[0],
        "cell_h_mm": config.cell_mm[1],
        "speed_mm_s": config.speed_mm_s,
        "blend_mm": config.blend_mm,
        "dip_every_strokes": config.dip_every_strokes,
    }


def _capture_params(stroke: Planned, sheet: int, cell: int) -> Params:
    params: Params = {
        "stroke_id": stroke.stroke_id,
        "height_mm": stroke.height_mm,
        "tilt_deg": stroke.tilt_deg,
        "sheet": sheet,
        "cell": cell,
    }
    if stroke.again_of is not None:
        params["again_of"] = stroke.again_of
    if stroke.figure is not None:
        params["drawn"] = True
    return params
