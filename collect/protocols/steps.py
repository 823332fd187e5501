"""Steps: the units of a protocol and of resume, each kind a class with its parameters. Then the strokes of a plan, and
the steps of each.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, ClassVar

from pydantic import Field, TypeAdapter

from brushloop.sessions.events import CaptureResult, DipResult, Press, PressResult, ReviewResult, StepKind, StepResult
from brushloop.sessions.records import Condition

MEASURED = {"reached_mm", "dip_to_touch_s"}
"""Fields of a press that are measured, and not asked for."""
InCellMm = Annotated[float, Field(ge=0.0, le=500.0)]
PathDepthMm = Annotated[float, Field(ge=-20.0, le=100.0)]
TiltDeg = Annotated[float, Field(ge=0.0, le=30.0)]
HeadingDeg = Annotated[float, Field(ge=-720.0, le=720.0)]
TrajectoryPoint = tuple[InCellMm, InCellMm, PathDepthMm, TiltDeg, HeadingDeg]
"""x, y in the figure's patch; depth below the touch height, negative above the paper; tilt; direction in which the
ferrule leans, counter-clockwise from the sheet's x."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """The strokes that a DRAW step draws on one patch."""

    strokes: list[list[TrajectoryPoint]]
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class StepBase:
    """Base of every kind of step. `index` distinguishes equal steps of one protocol."""

    kind: ClassVar[StepKind]
    index: int

    @property
    def key(self) -> str:
        """Stable across processes: sha256 of kind, parameters and index, without what was measured."""
        text = _adapter(type(self)).dump_json(self, exclude={"press": MEASURED}, exclude_defaults=True)
        return hashlib.sha256(f"{self.kind} ".encode() + text).hexdigest()

    @property
    def run_scoped(self) -> bool:
        """Whether every process must do the step again, even if a stored result exists: the first one finds the paper,
        and sees whether camera or board moved."""
        return self.kind in (StepKind.ZERO_TOUCH, StepKind.BOARD) and self.index == 0


@dataclass(frozen=True, slots=True)
class ZeroTouchStep(StepBase):
    """Find the paper: first with index 0, then between strokes where a person asks for it."""

    kind: ClassVar[StepKind] = StepKind.ZERO_TOUCH
    method: str | None = None
    """`jog` or `force`; None for the rig's method."""


@dataclass(frozen=True, slots=True)
class BoardStep(StepBase):
    """Photograph the board."""

    kind: ClassVar[StepKind] = StepKind.BOARD


@dataclass(frozen=True, slots=True)
class SelfCheckStep(StepBase):
    """Press an uneven triangle of marks, and find them in a photograph."""

    kind: ClassVar[StepKind] = StepKind.SELF_CHECK


@dataclass(frozen=True, slots=True)
class DipStep(StepBase):
    """Fill the brush."""

    kind: ClassVar[StepKind] = StepKind.DIP
    take: int = 1


@dataclass(frozen=True, slots=True)
class PressStep(StepBase):
    """Press once, or draw a figure, on the next free patch. If it is cut short, all of it is done again."""

    kind: ClassVar[StepKind] = StepKind.PRESS
    press: Press
    dwell_s: float = 0.0
    """Time at full depth."""
    drawn: Drawn | None = None
    """The figure; None for a press."""


@dataclass(frozen=True, slots=True)
class CaptureStep(StepBase):
    """Photograph what was pressed on one patch."""

    kind: ClassVar[StepKind] = StepKind.CAPTURE
    press: Press
    """As it was made, with its sheet and patch: a capture of another patch is another step."""
    again_of: str | None = None
    """The stroke of another session that this one repeats."""
    drawn: bool = False


@dataclass(frozen=True, slots=True)
class ReviewStep(StepBase):
    """Read which captures a person has marked bad."""

    kind: ClassVar[StepKind] = StepKind.REVIEW


Step = ZeroTouchStep | BoardStep | SelfCheckStep | DipStep | PressStep | CaptureStep | ReviewStep
_adapter = cache(TypeAdapter[Any])
"""What makes a kind of step JSON: made when it is first needed, which takes milliseconds."""
MARKING = frozenset({StepKind.PRESS, StepKind.SELF_CHECK})
"""Steps that leave ink on a paper patch of their own."""

Protocol = Generator[Step, StepResult | None, None]
"""Yields steps and is sent their results, so that later steps can depend on earlier ones; None for a step that was only
planned and has nothing to tell."""


def press_of(step: Step) -> Press | None:
    """The press that a step makes or photographs; None for the other kinds."""
    return step.press if isinstance(step, PressStep | CaptureStep) else None


AGAIN = "-again"


@dataclass(frozen=True, slots=True)
class Planned:
    """One press, or one figure of several strokes."""

    stroke_id: str
    condition: Condition
    """What is commanded; of a figure, at its deepest point."""
    index: int = 0
    """Number in the plan, which is part of the keys of its steps."""
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


def takes(stroke: Planned) -> Protocol:
    """Steps of one stroke: dip, press, capture; repeated while the capture asks for a retake."""
    index, drawn, again_of = stroke.index, stroke.drawn, stroke.again_of
    for take in itertools.count(1):
        dipped = yield DipStep(index, take)
        if isinstance(dipped, DipResult) and dipped.skipped is not None:
            break
        marked = yield PressStep(index, stroke.press(take), stroke.dwell_s, drawn)
        assert isinstance(marked, PressResult)
        seen = yield CaptureStep(index, marked.press, again_of, drawn is not None)
        if not (isinstance(seen, CaptureResult) and seen.retake):
            break
