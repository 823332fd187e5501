"""`replay`: the (H, alpha) that an inversion recovered from images, pressed again."""

from __future__ import annotations

from collect.protocols.config import ReplayConfig
from collect.protocols.order import numbered, shuffled
from collect.protocols.steps import Protocol
from collect.protocols.strokes import Planned, stroke_steps
from collect.rig.paper import Layout


def planned(config: ReplayConfig, layout: Layout | None = None) -> list[Planned]:
    """Every stroke `repeats` times. `H13-a5-r02` pressed again is `H13-a5-r02~1`, then `~2` and so on.

    A given id begins with no `~` but may hold one; what stands before the last is always the original's id, and
    `again_of` in the step's parameters says the same.
    """
    rounds = [
        [
            Planned(
                f"{row.stroke_id}~{repeat}",
                row.height_mm,
                row.tilt_deg,
                repeat,
                dwell_s=config.dwell_s,
                again_of=row.stroke_id,
            )
            for row in config.presses
        ]
        for repeat in range(1, config.repeats + 1)
    ]
    return numbered(shuffled(rounds, config.seed), config.seed, layout)


def steps(config: ReplayConfig, layout: Layout | None = None) -> Protocol:
    """Zero touch, board, then dip, press, capture for each stroke."""
    return stroke_steps(planned(config, layout), board_every=config.board_every)
