"""`calibration`: touches and views of the board, for a sheet without ink."""

from __future__ import annotations

from collect.protocols.config import CalibrationConfig
from collect.protocols.steps import Protocol, Step, StepKind


def steps(config: CalibrationConfig) -> Protocol:
    """Zero touch, then in each round every touch and every view of the board."""
    yield Step(StepKind.ZERO_TOUCH, 0)
    touches = views = 0
    for _ in range(config.rounds):
        for x_mm, y_mm in config.touches_mm:
            yield Step(StepKind.TOUCH, touches, {"x_mm": x_mm, "y_mm": y_mm})
            touches += 1
        for _ in range(config.board_views):
            yield Step(StepKind.BOARD, views)
            views += 1
