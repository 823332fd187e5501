"""What every kind of protocol has: its common fields, its strokes, their order over the sheet, and their steps.

Conditions of a design are spread over the sheet. Its patches are used in order, so a stroke's number determines
its place. The sheet is cut into three bands of rows and three of columns; within each round, pairs of strokes change
places wherever that evens out how often each (H, alpha) lies in each band. Rounds stay whole, so a drift of ink still
affects every condition alike. A void press shifts what follows by one patch: only the plan stays balanced.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

from pydantic import AfterValidator, BaseModel, Field

from brushloop.collect.protocols.steps import (
    BoardStep,
    CaptureStep,
    DipStep,
    Drawn,
    DrawStep,
    PressStep,
    Protocol,
    ZeroTouchStep,
)
from brushloop.collect.rig.config_file import Config
from brushloop.collect.rig.paper import Layout
from brushloop.sessions.events import (
    CaptureResult,
    Condition,
    DipResult,
    Press,
    PressResult,
    ReviewResult,
)

AGAIN = "-again"


@dataclass(frozen=True, slots=True)
class Planned:
    """One press, or one figure of several strokes."""

    stroke_id: str
    condition: Condition
    """What is commanded; of a figure, at its deepest point."""
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

    def press(self, take: int = 1) -> Press:
        """The press of one take."""
        return Press(stroke_id=self.stroke_id, condition=self.condition, take=take)


def with_review(plan: Iterable[Planned], reviewed: ReviewResult) -> list[Planned]:
    """The plan after a REVIEW step: each stroke that was marked bad is replaced by the same under another name.

    The recording holds both, and the first stays marked bad.
    """
    indices = {again.stroke_id: again.index for again in reviewed.again}
    return [
        replace(p, stroke_id=f"{p.stroke_id}{AGAIN}", index=indices[p.stroke_id]) if p.stroke_id in indices else p
        for p in plan
    ]


def stroke_steps(plan: Iterable[Planned], *, board_every: int | None) -> Protocol:
    """Zero touch, board, then dip, press or draw, capture for each stroke of the plan."""
    yield ZeroTouchStep(0)
    yield BoardStep(0)
    for number, stroke in enumerate(plan):
        if board_every is not None and number > 0 and number % board_every == 0:
            yield BoardStep(number // board_every)
        yield from takes(stroke)


def takes(stroke: Planned) -> Protocol:
    """Steps of one stroke: dip, press or draw, capture; repeated while the capture asks for a retake."""
    index, drawn, again_of = stroke.index, stroke.drawn, stroke.again_of
    for take in itertools.count(1):
        dipped = yield DipStep(index, take)
        if isinstance(dipped, DipResult) and dipped.skipped is not None:
            break
        press = stroke.press(take)
        step = PressStep(index, press, stroke.dwell_s, again_of) if drawn is None else DrawStep(index, press, drawn)
        marked = yield step
        assert isinstance(marked, PressResult)
        seen = yield CaptureStep(index, marked.press, again_of, drawn is not None)
        if not (isinstance(seen, CaptureResult) and seen.retake):
            break


def numbered(rounds: list[list[Planned]], seed: int | None, layout: Layout | None) -> list[Planned]:
    """Put the rounds one after the other and number the strokes; with a seed and a layout, balance over the sheet."""
    index = 0
    for strokes in rounds:
        for k, stroke in enumerate(strokes):
            strokes[k] = replace(stroke, index=index)
            index += 1
    if seed is not None and layout is not None and layout.capacity > 0:
        conditions = [[stroke.condition for stroke in strokes] for strokes in rounds]
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


MAX_STROKES = 10_000
"""Most strokes of one protocol, repeats included: a month of pressing."""

DeepMm = Annotated[float, Field(gt=0.0, le=100.0)]
DwellS = Annotated[float, Field(ge=0.0, le=60.0)]
Repeats = Annotated[int, Field(ge=1, le=1000)]
Seed = Annotated[int, Field(ge=0)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]
MAX_ID = 100


class ProtocolBase(Config):
    """Fields and methods of every kind. A kind adds its own fields, `kind` among them, and `planned`."""

    depths_field: ClassVar[str] = "presses"
    """The field that the error names if a depth is more than the brush can take."""
    row: ClassVar[type[BaseModel] | None] = None
    """Model of a row of the CSV that `file` names; the rows become `presses`."""
    ignores_columns: ClassVar[bool] = False
    """Whether other columns of that CSV are noted in `ignored_columns` instead of refused."""

    board_every: Annotated[int, Field(ge=1, le=MAX_STROKES)] | None = None
    """Photograph the board again after this many strokes, to see whether camera or sheet moved; if left out, only at
    the start."""
    wait_after_dip_s: Annotated[float, Field(ge=0.0, le=600.0)] | None = Field(
        default=None, exclude_if=lambda wait_s: wait_s is None
    )
    """Wait over the patch until this much time has passed since the brush left the ink. If left out, it presses at
    once and the field is not written, so that protocols written before it existed stay the same."""

    @property
    def own_patch_mm(self) -> tuple[float, float] | None:
        """Size of the paper patch that each stroke needs; None for that of the rig, `paper.cell_mm`."""
        return None

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every stroke exactly once, in order; none for a protocol that marks nothing.

        With a `layout`, conditions of a design are spread over the sheet.
        """
        return []

    def steps(self, layout: Layout | None = None) -> Protocol:
        """Return the generator of steps. The layout changes the order of the steps, never their keys."""
        return stroke_steps(self.planned(layout), board_every=self.board_every)


def check_count(strokes: int) -> None:
    """Raise ValueError for more strokes than a protocol may have."""
    if strokes > MAX_STROKES:
        raise ValueError(f"{strokes} strokes with repeats, at most {MAX_STROKES}")


def check_distinct(field: str, values: Iterable[object]) -> None:
    """Raise ValueError if a value occurs twice."""
    seen: set[object] = set()
    for value in values:
        if value in seen:
            raise ValueError(f"{field}: {value!r} occurs twice")
        seen.add(value)


def _stroke_id(ident: str) -> str:
    if not 1 <= len(ident) <= MAX_ID:
        raise ValueError(f"a name has 1 to {MAX_ID} characters")
    if not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident) or ident[0] in ".-~":
        what = 'a name has no spaces, control characters, slashes or any of < > : " | ? *, and begins with no . - ~'
        raise ValueError(what)
    return ident


StrokeId = Annotated[str, AfterValidator(_stroke_id)]
"""A name that names files and is shown on terminals."""
