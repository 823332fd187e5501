"""`adaptive`: presses chosen one by one. Which comes next is the result of a CHOOSE step, so a resume replays it."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from collect.protocols.base import MAX_STROKES, DeepMm, DwellS, ProtocolBase, Repeats, check_axes, check_count
from collect.protocols.plan import Planned, TiltDeg, takes
from collect.protocols.steps import Protocol, Result, Step, StepKind
from collect.rig.paper import Layout


class AdaptiveConfig(ProtocolBase):
    """Presses chosen one by one, each where it tells most about the brush, until little more can be learned."""

    depths_field: ClassVar[str] = "heights_mm"

    kind: Literal["adaptive"]
    heights_mm: Annotated[list[DeepMm], Field(min_length=1, max_length=100)]
    """Depths H below the touch height."""
    tilts_deg: Annotated[list[TiltDeg], Field(min_length=1, max_length=100)]
    """Tilts alpha from the paper's normal."""
    repeats: Repeats = 10
    """Rounds of the grid that this protocol replaces; saved presses are counted against that grid."""
    most_presses: Annotated[int, Field(ge=1, le=MAX_STROKES)] | None = None
    """Stop after this many at the latest; left out, as many as the grid has. No fewer than the cells: limits, ink and
    sheets are planned for the worst case, in which every cell is chosen."""
    least_presses: Annotated[int, Field(ge=3, le=1000)] = 5
    """Do not stop before this many."""
    enough_points: Annotated[float, Field(gt=0.0, le=50.0)] = 1.0
    """Stop when further presses are expected to gain fewer CSIM points (percent, mean over all cells)."""
    dwell_s: DwellS = 0.2
    """Time at full depth."""

    @model_validator(mode="after")
    def _whole(self) -> AdaptiveConfig:
        check_axes(self.heights_mm, self.tilts_deg)
        check_count(self.whole_grid)
        cells = len(self.heights_mm) * len(self.tilts_deg)
        if self.most < cells:
            raise ValueError(f"most_presses = {self.most}: at least the {cells} cells of the grid")
        if self.least_presses > self.most:
            raise ValueError(f"least_presses = {self.least_presses}: at most most_presses = {self.most}")
        return self

    @property
    def whole_grid(self) -> int:
        """Presses of the grid that this protocol replaces."""
        return len(self.heights_mm) * len(self.tilts_deg) * self.repeats

    @property
    def most(self) -> int:
        """Presses in the worst case."""
        return self.whole_grid if self.most_presses is None else self.most_presses

    @property
    def cells(self) -> list[tuple[float, float]]:
        """(H, alpha) that can be chosen, in the order of the grid."""
        return [(h, a) for h in self.heights_mm for a in self.tilts_deg]

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """The worst case: as many presses as allowed, the cells in turn."""
        every = self.cells
        return [self._stroke(number, *every[number % len(every)]) for number in range(self.most)]

    def steps(self, layout: Layout | None = None) -> Protocol:
        """Zero touch, board, then choose, dip, press, capture, until the choice is to stop.

        A CHOOSE step without an answer, as when a plan is walked, stands for the worst case.
        """
        yield Step(StepKind.ZERO_TOUCH, 0)
        yield Step(StepKind.BOARD, 0)
        for worst in self.planned():
            number = worst.index
            if self.board_every is not None and number > 0 and number % self.board_every == 0:
                yield Step(StepKind.BOARD, number // self.board_every)
            chosen = yield Step(StepKind.CHOOSE, number)
            if chosen.get("stop"):
                return
            cell = (worst.height_mm, worst.tilt_deg)
            if "height_mm" in chosen:
                cell = (float(chosen["height_mm"]), float(chosen["tilt_deg"]))
            yield from takes(self._stroke(number, *cell), measured=True)
        yield Step(StepKind.CHOOSE, self.most, {"last": True})

    def _stroke(self, number: int, height_mm: float, tilt_deg: float) -> Planned:
        return Planned(_name(number, height_mm, tilt_deg), height_mm, tilt_deg, 1, number, dwell_s=self.dwell_s)


def with_choice(plan: list[Planned], chosen: Result) -> list[Planned]:
    """The worst case `plan` after a CHOOSE step: its stroke is the chosen one, or nothing more is planned."""
    number = int(chosen["number"])
    if chosen["stop"]:
        return plan[:number]
    height_mm, tilt_deg = float(chosen["height_mm"]), float(chosen["tilt_deg"])
    name = _name(number, height_mm, tilt_deg)
    made = replace(plan[number], stroke_id=name, height_mm=height_mm, tilt_deg=tilt_deg)
    return [*plan[:number], made, *plan[number + 1 :]]


def _name(number: int, height_mm: float, tilt_deg: float) -> str:
    return f"{number + 1:03d}-H{height_mm:g}-a{tilt_deg:g}"
