"""Base of every kind of protocol: common fields, bounds, and the strokes and steps that follow from them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar

from pydantic import AfterValidator, BaseModel, Field

from brushloop.collect.protocols.plan import Planned, stroke_steps
from brushloop.collect.protocols.steps import Protocol
from brushloop.collect.rig.config_file import Config
from brushloop.collect.rig.paper import Layout

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


def check_axes(depths_mm: list[float], tilts_deg: list[float]) -> None:
    """Raise ValueError if an axis of a grid has a value twice."""
    for name, values in (("depths_mm", depths_mm), ("tilts_deg", tilts_deg)):
        if len(set(values)) != len(values):
            raise ValueError(f"{name} has the same value twice: {values}")


def check_distinct(field: str, values: Iterable[object]) -> None:
    """Raise ValueError if a value occurs twice."""
    seen: set[object] = set()
    for value in values:
        if value in seen:
            raise ValueError(f"{field}: {value!r} occurs twice")
        seen.add(value)


def stroke_id_problem(ident: str) -> str:
    """Reason why this is no valid stroke id, which names files and is shown on terminals; empty if it is valid."""
    if not 1 <= len(ident) <= MAX_ID:
        return f"a name has 1 to {MAX_ID} characters"
    if not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident) or ident[0] in ".-~":
        return 'a name has no spaces, control characters, slashes or any of < > : " | ? *, and begins with no . - ~'
    return ""


def _stroke_id(ident: str) -> str:
    if problem := stroke_id_problem(ident):
        raise ValueError(problem)
    return ident


StrokeId = Annotated[str, AfterValidator(_stroke_id)]
