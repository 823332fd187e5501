"""Protocols: generators of steps."""

from __future__ import annotations

import random
from dataclasses import dataclass

from collect.config import GridConfig
from collect.steps import Protocol, Step, StepKind


@dataclass(frozen=True, slots=True)
class Planned:
    """One stroke of the grid."""

    stroke_id: str
    height_mm: float
    tilt_deg: float
    repeat: int


def plan_grid(config: GridConfig) -> list[Planned]:
    """Every cell of the grid `repeats` times; each round holds all cells once, in its own shuffled order.

    Rounds keep a drift of ink or paper from looking like an effect of H or alpha.
    """
    rng = random.Random(config.seed)
    cells = [(h, a) for h in config.heights_mm for a in config.tilts_deg]
    planned: list[Planned] = []
    for repeat in range(1, config.repeats + 1):
        rng.shuffle(cells)
        planned += [Planned(f"H{h:g}-a{a:g}-r{repeat:02d}", h, a, repeat) for h, a in cells]
    return planned


def grid(config: GridConfig) -> Protocol:
    """Zero touch, board, then dip, press, capture for each stroke of the plan."""
    yield Step(StepKind.ZERO_TOUCH, 0)
    yield Step(StepKind.BOARD, 0)
    for index, stroke in enumerate(plan_grid(config)):
        yield Step(StepKind.DIP, index)
        pressed = yield Step(
            StepKind.PRESS,
            index,
            {
                "stroke_id": stroke.stroke_id,
                "height_mm": stroke.height_mm,
                "tilt_deg": stroke.tilt_deg,
                "dwell_s": config.dwell_s,
            },
        )
        # A capture belongs to one cell: pressed again elsewhere, it is another step.
        yield Step(
            StepKind.CAPTURE,
            index,
            {
                "stroke_id": stroke.stroke_id,
                "height_mm": stroke.height_mm,
                "tilt_deg": stroke.tilt_deg,
                "sheet": int(pressed["sheet"]),
                "cell": int(pressed["cell"]),
            },
        )
