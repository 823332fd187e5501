"""`grid`: every depth at every tilt, in rounds."""

from __future__ import annotations

import random

from collect.protocols.config import GridConfig
from collect.protocols.order import numbered
from collect.protocols.steps import Protocol
from collect.protocols.strokes import Planned, stroke_steps
from collect.rig.paper import Layout


def planned(config: GridConfig, layout: Layout | None = None) -> list[Planned]:
    """Every cell of the grid `repeats` times; each round holds all cells once, in its own shuffled order.

    Rounds keep a drift of ink or paper from looking like an effect of H or alpha. With a layout, each (H, alpha) is
    spread over the sheet as well, so that neither does unevenness of the paper or of the camera's view.
    """
    rng = random.Random(config.seed)
    cells = [(h, a) for h in config.heights_mm for a in config.tilts_deg]
    rounds: list[list[Planned]] = []
    for repeat in range(1, config.repeats + 1):
        rng.shuffle(cells)
        rounds.append([Planned(f"H{h:g}-a{a:g}-r{repeat:02d}", h, a, repeat, dwell_s=config.dwell_s) for h, a in cells])
    return numbered(rounds, config.seed, layout)


def steps(config: GridConfig, layout: Layout | None = None) -> Protocol:
    """Zero touch, board, then dip, press, capture for each stroke of the plan."""
    return stroke_steps(planned(config, layout), board_every=config.board_every)
