"""`calibration`: touches and views of the board, for a sheet without ink."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from brushloop.collect.protocols.base import ProtocolBase, check_count
from brushloop.collect.protocols.steps import BoardStep, Protocol, TouchStep, ZeroTouchStep
from brushloop.collect.rig.config_file import Finite
from brushloop.collect.rig.paper import Layout


class CalibrationConfig(ProtocolBase):
    """Touches and views of the board, nothing else: no ink, no mark."""

    kind: Literal["calibration"]
    touches_mm: Annotated[tuple[tuple[Finite, Finite], ...], Field(max_length=200)] = ()
    """Points of the sheet to touch, x and y in the paper frame. Three that are not on a line give the sheet's slope."""
    rounds: Annotated[int, Field(ge=1, le=100)] = 1
    """How often all of them are touched: the spread of a point over the rounds shows how well a touch repeats."""
    board_views: Annotated[int, Field(ge=1, le=1000)] = 1
    """How often the board is photographed in each round."""

    @model_validator(mode="after")
    def _apart(self) -> CalibrationConfig:
        if self.board_every is not None:
            raise ValueError("board_every counts strokes, and this protocol has none: use board_views")
        if self.wait_after_dip_s is not None:
            raise ValueError("wait_after_dip_s: this protocol has no dips")
        if len(set(self.touches_mm)) != len(self.touches_mm):
            raise ValueError("touches_mm contains the same point twice: use rounds")
        check_count((len(self.touches_mm) + self.board_views) * self.rounds)
        return self

    def steps(self, layout: Layout | None = None) -> Protocol:
        """Zero touch, then in each round every touch and every view of the board."""
        yield ZeroTouchStep(0)
        touches = views = 0
        for _ in range(self.rounds):
            for x_mm, y_mm in self.touches_mm:
                yield TouchStep(touches, x_mm, y_mm)
                touches += 1
            for _ in range(self.board_views):
                yield BoardStep(views)
                views += 1
