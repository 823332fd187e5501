"""Steps: the units of a protocol and of resume. Each kind is a class with its parameters."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Generator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, get_args

from pydantic import Field, TypeAdapter

from brushloop.sessions.events import Press, StepKind, StepResult

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
    cell_mm: tuple[float, float]
    """Size of the figure's patch."""
    speed_mm_s: float
    blend_mm: float
    dip_every_strokes: int

    def dips_before(self, stroke: int) -> bool:
        """Whether the brush dips again before that stroke, counted from 0; the DIP step already served stroke 0."""
        return stroke > 0 and self.dip_every_strokes > 0 and stroke % self.dip_every_strokes == 0


@dataclass(frozen=True, slots=True)
class StepBase:
    """Base of every kind of step. `index` distinguishes equal steps of one protocol."""

    kind: ClassVar[StepKind]
    index: int

    @property
    def key(self) -> str:
        """Stable across processes: sha256 of kind, parameters and index, without what was measured."""
        text = _ADAPTERS[self.kind].dump_json(self, exclude={"press": MEASURED}, exclude_defaults=True)
        return hashlib.sha256(f"{self.kind} ".encode() + text).hexdigest()

    @property
    def run_scoped(self) -> bool:
        """Whether every process must do the step again, even if a stored result exists: the first one finds the paper,
        and sees whether camera or board moved."""
        return self.kind in (StepKind.ZERO_TOUCH, StepKind.BOARD) and self.index == 0


@dataclass(frozen=True, slots=True)
class ZeroTouchStep(StepBase):
    """Find the paper."""

    kind: ClassVar[StepKind] = StepKind.ZERO_TOUCH
    method: str | None = None
    """`jog`, `force`, or `kept` for the height known before; None for the rig's method."""
    between_strokes: bool = False
    """A person asked for it between two strokes, and accepts the new height."""


@dataclass(frozen=True, slots=True)
class BoardStep(StepBase):
    """Photograph the board."""

    kind: ClassVar[StepKind] = StepKind.BOARD


@dataclass(frozen=True, slots=True)
class TouchStep(StepBase):
    """Bring the tip down on a point of the sheet and measure its height."""

    kind: ClassVar[StepKind] = StepKind.TOUCH
    x_mm: float
    y_mm: float


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
    """Press once, on the next free patch."""

    kind: ClassVar[StepKind] = StepKind.PRESS
    press: Press
    dwell_s: float = 0.0
    """Time at full depth."""
    again_of: str | None = None
    """The stroke of another session that this one repeats."""


@dataclass(frozen=True, slots=True)
class DrawStep(StepBase):
    """Draw a figure on the next free patch."""

    kind: ClassVar[StepKind] = StepKind.DRAW
    press: Press
    drawn: Drawn


@dataclass(frozen=True, slots=True)
class CaptureStep(StepBase):
    """Photograph what was pressed on one patch."""

    kind: ClassVar[StepKind] = StepKind.CAPTURE
    press: Press
    """As it was made, with its sheet and patch: a capture of another patch is another step."""
    again_of: str | None = None
    drawn: bool = False


@dataclass(frozen=True, slots=True)
class ReviewStep(StepBase):
    """Read which captures a person has marked bad."""

    kind: ClassVar[StepKind] = StepKind.REVIEW


Step = ZeroTouchStep | BoardStep | TouchStep | SelfCheckStep | DipStep | PressStep | DrawStep | CaptureStep | ReviewStep
_ADAPTERS = {step.kind: TypeAdapter[Any](step) for step in get_args(Step)}
MARKING = frozenset({StepKind.PRESS, StepKind.DRAW, StepKind.SELF_CHECK})
"""Steps that leave ink on a paper patch of their own."""

Protocol = Generator[Step, StepResult | None, None]
"""Yields steps and is sent their results, so that later steps can depend on earlier ones; None for a step that was only
planned and has nothing to tell."""
KNOWING = frozenset({StepKind.ZERO_TOUCH, StepKind.TOUCH, StepKind.BOARD})
"""Steps that come before the self-check, which needs paper and board."""


def with_self_check(protocol: Protocol) -> Protocol:
    """The same protocol, with a SELF_CHECK step before the first one that prepares a mark."""
    step = next(protocol)
    checked = False
    with contextlib.suppress(StopIteration):
        while True:
            if not checked and step.kind not in KNOWING:
                yield SelfCheckStep(0)
                checked = True
            step = protocol.send((yield step))


def press_of(step: Step) -> Press | None:
    """The press that a step makes or photographs; None for the other kinds."""
    return step.press if isinstance(step, PressStep | DrawStep | CaptureStep) else None
