"""What a protocol has planned, stroke by stroke, and the steps that each stroke takes."""

from __future__ import annotations

import itertools
import json
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace

from collect.protocols.config import Figure, WriteConfig
from collect.protocols.rows import TrajectoryPoint
from collect.protocols.steps import Params, Protocol, Result, Step, StepKind


@dataclass(frozen=True, slots=True)
class Planned:
    """One stroke, or one figure of several."""

    stroke_id: str
    height_mm: float
    """Depth; of a figure, its deepest."""
    tilt_deg: float
    """Of a figure, at its deepest point."""
    repeat: int
    """Round, from 1."""
    index: int = 0
    """Number in the plan before it was balanced over the sheet: what its steps' keys are made with, so that they do not
    depend on the sheet."""
    dwell_s: float = 0.0
    figure: Figure | None = None
    """What is drawn; None is a press."""
    cell_mm: tuple[float, float] | None = None
    """Paper cell that it needs; None is the rig's own, `paper.cell_mm`."""
    again_of: str | None = None
    """The stroke of another session that this one repeats."""


AGAIN = "-again"


def made_again(marked: Planned, index: int) -> Planned:
    """The same press under a name of its own: both are in the recording, and the first stays marked."""
    return replace(marked, stroke_id=f"{marked.stroke_id}{AGAIN}", index=index)


def with_review(plan: Iterable[Planned], reviewed: Result) -> list[Planned]:
    """The plan after a REVIEW step: each marked stroke gives its place to the one that is made again.

    `reviewed` holds `again`: [stroke_id, index] of each.
    """
    indices = {str(stroke_id): int(index) for stroke_id, index in reviewed["again"]}
    return [made_again(p, indices[p.stroke_id]) if p.stroke_id in indices else p for p in plan]


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
