"""The plan of a protocol: its strokes, their order over the sheet, and the steps that each stroke takes.

Conditions of a design are spread over the sheet. Its patches are used in order, so a stroke's number determines
its place. The sheet is cut into three bands of rows and three of columns; within each round, pairs of strokes change
places wherever that evens out how often each (H, alpha) lies in each band. Rounds stay whole, so a drift of ink still
affects every condition alike. A void press shifts what follows by one patch: only the plan stays balanced.
"""

from __future__ import annotations

import itertools
import json
import random
from collections.abc import Generator, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from brushloop.collect.protocols.steps import Params, Protocol, Result, Step, StepKind
from brushloop.collect.rig.paper import Layout

InCellMm = Annotated[float, Field(ge=0.0, le=500.0)]
PathDepthMm = Annotated[float, Field(ge=-20.0, le=100.0)]
TiltDeg = Annotated[float, Field(ge=0.0, le=30.0)]
HeadingDeg = Annotated[float, Field(ge=-720.0, le=720.0)]
TrajectoryPoint = tuple[InCellMm, InCellMm, PathDepthMm, TiltDeg, HeadingDeg]
"""x, y in the figure's patch; depth below the touch height, negative above the paper; tilt; direction in which the
ferrule leans, counter-clockwise from the sheet's x."""
AGAIN = "-again"


@dataclass(frozen=True, slots=True)
class Drawn:
    """The figure that a DRAW step draws."""

    strokes: list[list[TrajectoryPoint]]
    cell_mm: tuple[float, float]
    """Size of the figure's patch."""
    speed_mm_s: float
    blend_mm: float
    dip_every_strokes: int

    @classmethod
    def of(cls, step: Step) -> Drawn:
        """The figure in a step's parameters. Raises KeyError or ValueError for a step that draws nothing."""
        params = step.params
        return cls(
            strokes_of(str(params["strokes"])),
            (float(params["cell_w_mm"] or 0), float(params["cell_h_mm"] or 0)),
            float(params["speed_mm_s"] or 0),
            float(params["blend_mm"] or 0),
            int(params["dip_every_strokes"] or 0),
        )

    @property
    def params(self) -> Params:
        """The figure as a step's parameters."""
        return {
            "strokes": strokes_text(self.strokes),
            "cell_w_mm": self.cell_mm[0],
            "cell_h_mm": self.cell_mm[1],
            "speed_mm_s": self.speed_mm_s,
            "blend_mm": self.blend_mm,
            "dip_every_strokes": self.dip_every_strokes,
        }

    def dips_before(self, stroke: int) -> bool:
        """Whether the brush dips again before that stroke, counted from 0; the DIP step already served stroke 0."""
        return stroke > 0 and self.dip_every_strokes > 0 and stroke % self.dip_every_strokes == 0


@dataclass(frozen=True, slots=True)
class Planned:
    """One press, or one figure of several strokes."""

    stroke_id: str
    depth_mm: float
    """Depth of the press; of a figure, its greatest depth."""
    tilt_deg: float
    """Tilt of the press; of a figure, at its deepest point."""
    repeat: int
    """Round, from 1."""
    index: int = 0
    """Number in the plan before it was balanced over the sheet. The keys of its steps are made with it, so that they do
    not depend on the sheet."""
    dwell_s: float = 0.0
    drawn: Drawn | None = None
    """The figure; None for a press."""
    again_of: str | None = None
    """The stroke of another session that this one repeats."""


def made_again(marked: Planned, index: int) -> Planned:
    """The same press under a new name: the recording holds both, and the first stays marked bad."""
    return replace(marked, stroke_id=f"{marked.stroke_id}{AGAIN}", index=index)


def with_review(plan: Iterable[Planned], reviewed: Result) -> list[Planned]:
    """The plan after a REVIEW step: each stroke that was marked bad is replaced by its repetition.

    `reviewed` holds `again`: [stroke_id, index] of each.
    """
    indices = {str(stroke_id): int(index) for stroke_id, index in reviewed["again"]}
    return [made_again(p, indices[p.stroke_id]) if p.stroke_id in indices else p for p in plan]


def stroke_steps(plan: Iterable[Planned], *, board_every: int | None) -> Protocol:
    """Zero touch, board, then dip, press or draw, capture for each stroke of the plan."""
    yield Step(StepKind.ZERO_TOUCH, 0)
    yield Step(StepKind.BOARD, 0)
    for number, stroke in enumerate(plan):
        if board_every is not None and number > 0 and number % board_every == 0:
            yield Step(StepKind.BOARD, number // board_every)
        yield from takes(stroke)


def takes(stroke: Planned) -> Generator[Step, Result, None]:
    """Steps of one stroke: dip, press or draw, capture; repeated while the capture asks for a retake."""
    for take in itertools.count(1):
        # Only later takes are numbered, so that the keys of first takes match those of older sessions.
        taken: Params = {} if take == 1 else {"take": take}
        dipped = yield Step(StepKind.DIP, stroke.index, taken)
        if dipped.get("skipped"):
            break
        kind = StepKind.PRESS if stroke.drawn is None else StepKind.DRAW
        marked = yield Step(kind, stroke.index, _mark_params(stroke) | taken)
        # A capture belongs to one patch: a capture of another patch is another step.
        place = _capture_params(stroke, int(marked["sheet"]), int(marked["patch"]))
        seen = yield Step(StepKind.CAPTURE, stroke.index, place | taken)
        if not seen.get("retake"):
            break


def strokes_text(strokes: Iterable[Iterable[TrajectoryPoint]]) -> str:
    """Trajectories as text for a step's parameter: JSON, [stroke][point][x, y, height, tilt, heading]."""
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


def _mark_params(stroke: Planned) -> Params:
    params: Params = {"stroke_id": stroke.stroke_id, "depth_mm": stroke.depth_mm, "tilt_deg": stroke.tilt_deg}
    if stroke.drawn is not None:
        return params | stroke.drawn.params
    params["dwell_s"] = stroke.dwell_s
    return params if stroke.again_of is None else {**params, "again_of": stroke.again_of}


def _capture_params(stroke: Planned, sheet: int, patch: int) -> Params:
    params: Params = {
        "stroke_id": stroke.stroke_id,
        "depth_mm": stroke.depth_mm,
        "tilt_deg": stroke.tilt_deg,
        "sheet": sheet,
        "patch": patch,
    }
    if stroke.again_of is not None:
        params["again_of"] = stroke.again_of
    if stroke.drawn is not None:
        params["drawn"] = True
    return params


def numbered(rounds: list[list[Planned]], seed: int | None, layout: Layout | None) -> list[Planned]:
    """Put the rounds one after the other and number the strokes; with a seed and a layout, balance over the sheet."""
    index = 0
    for strokes in rounds:
        for k, stroke in enumerate(strokes):
            strokes[k] = replace(stroke, index=index)
            index += 1
    if seed is not None and layout is not None and layout.capacity > 0:
        conditions = [[(s.depth_mm, s.tilt_deg) for s in strokes] for strokes in rounds]
        orders = balanced(conditions, layout, seed)
        rounds = [[strokes[i] for i in order] for strokes, order in zip(rounds, orders, strict=True)]
    return [stroke for strokes in rounds for stroke in strokes]


def shuffled(rounds: list[list[Planned]], seed: int | None) -> list[list[Planned]]:
    """Shuffle each round; without a seed, leave it as it is."""
    if seed is not None:
        rng = random.Random(seed)
        for strokes in rounds:
            rng.shuffle(strokes)
    return rounds


BANDS = 3
TRIALS_PER_STROKE = 60
"""Pairs tried for each stroke of a round; more hardly changes the result."""


def balanced(rounds: Sequence[Sequence[Hashable]], layout: Layout, seed: int) -> list[list[int]]:
    """The order of each round, as indices into it.

    `rounds` holds the condition of every stroke. The same arguments give the same order in every process.
    """
    rng = random.Random(f"balance {seed}")
    share = _shares(layout)
    seen: dict[Hashable, list[int]] = {}
    orders: list[list[int]] = []
    places = (place for place in itertools.count() if place not in layout.taken)
    for conditions in rounds:
        order = list(range(len(conditions)))
        bands = [_bands(layout, next(places)) for _ in order]
        for condition, at in zip(conditions, bands, strict=True):
            _count(seen.setdefault(condition, [0] * (2 * BANDS)), at, 1)
        for _ in range(TRIALS_PER_STROKE * len(order) if len(order) > 1 else 0):
            i, k = rng.sample(range(len(order)), 2)
            a, b = conditions[order[i]], conditions[order[k]]
            if a == b or bands[i] == bands[k]:
                continue
            before = _unevenness(seen[a], share) + _unevenness(seen[b], share)
            _exchange(seen[a], seen[b], bands[i], bands[k])
            if _unevenness(seen[a], share) + _unevenness(seen[b], share) < before - 1e-9:
                order[i], order[k] = order[k], order[i]
            else:
                _exchange(seen[a], seen[b], bands[k], bands[i])
        orders.append(order)
    return orders


def _bands(layout: Layout, place: int) -> tuple[int, int]:
    """(row band, column band) of the stroke with that number; column bands are numbered after the row bands."""
    row, column = divmod(place % layout.capacity, layout.columns)
    return BANDS * row // layout.rows, BANDS + BANDS * column // layout.columns


def _shares(layout: Layout) -> list[float]:
    """Share of the sheet that each band holds; bands that hold nothing count as one patch."""
    counts = [0] * (2 * BANDS)
    for place in range(layout.capacity):
        _count(counts, _bands(layout, place), 1)
    return [max(count, 1) / layout.capacity for count in counts]


def _count(counts: list[int], bands: tuple[int, int], by: int) -> None:
    for band in bands:
        counts[band] += by


def _exchange(a: list[int], b: list[int], from_bands: tuple[int, int], to_bands: tuple[int, int]) -> None:
    for counts, out, into in ((a, from_bands, to_bands), (b, to_bands, from_bands)):
        _count(counts, out, -1)
        _count(counts, into, 1)


def _unevenness(counts: list[int], share: list[float]) -> float:
    """Measure of unevenness: smallest if the counts are in proportion to the shares."""
    return sum(count * count / part for count, part in zip(counts, share, strict=True))
