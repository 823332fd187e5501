"""`list`: presses one by one."""

from __future__ import annotations

from collect.protocols.config import ListConfig
from collect.protocols.order import numbered, shuffled
from collect.protocols.steps import Protocol
from collect.protocols.strokes import Planned, stroke_steps
from collect.rig.paper import Layout


def planned(config: ListConfig, layout: Layout | None = None) -> list[Planned]:
    """Every press `repeats` times, in rounds; shuffled and balanced over the sheet where there is a seed."""
    rounds = [
        [
            Planned(
                name,
                row.height_mm,
                row.tilt_deg,
                repeat,
                dwell_s=config.dwell_s if row.dwell_s is None else row.dwell_s,
            )
            for row, name in zip(config.presses, config.names(repeat), strict=True)
        ]
        for repeat in range(1, config.repeats + 1)
    ]
    return numbered(shuffled(rounds, config.seed), config.seed, layout)


def steps(config: ListConfig, layout: Layout | None = None) -> Protocol:
    """Zero touch, board, then dip, press, capture for each press of the list."""
    return stroke_steps(planned(config, layout), board_every=config.board_every)
