"""`write`: figures of trajectories, each on a paper cell of its own."""

from __future__ import annotations

from collect.protocols.config import WriteConfig
from collect.protocols.order import shuffled
from collect.protocols.steps import Protocol
from collect.protocols.strokes import Planned, stroke_steps
from collect.rig.paper import Layout


def planned(config: WriteConfig, layout: Layout | None = None) -> list[Planned]:
    """Every figure `repeats` times, in rounds. `layout` changes nothing: figures are not conditions of a design."""
    rounds: list[list[Planned]] = []
    index = 0
    for repeat in range(1, config.repeats + 1):
        strokes: list[Planned] = []
        for figure in config.figures:
            _, _, height_mm, tilt_deg, _ = max((s.deepest for s in figure.strokes), key=lambda point: point[2])
            strokes.append(
                Planned(
                    f"{figure.name}-r{repeat:02d}",
                    height_mm,
                    tilt_deg,
                    repeat,
                    index,
                    figure=figure,
                    cell_mm=config.cell_mm,
                )
            )
            index += 1
        rounds.append(strokes)
    return [stroke for strokes in shuffled(rounds, config.seed) for stroke in strokes]


def steps(config: WriteConfig, layout: Layout | None = None) -> Protocol:
    """Zero touch, board, then dip, draw, capture for each figure."""
    return stroke_steps(planned(config, layout), board_every=config.board_every, write=config)
