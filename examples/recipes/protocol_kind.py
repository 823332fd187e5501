"""A kind of protocol: one press after the other, each a little deeper, as often as asked.

Put the configuration into `collect/protocols/config.py` and into its union `ProtocolConfig`, the two functions into a
file of their own beside it, and a `case` into both functions of `collect/protocols/plans.py`; pyright names the places
that are still missing. Steps, keys, resume, limits, plan, screen and recording then work for the new kind as well.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from collect.protocols.config import ProtocolBase
from collect.protocols.steps import Protocol
from collect.protocols.strokes import Planned, stroke_steps
from collect.rig.paper import Layout


class StairsConfig(ProtocolBase):
    """`kind = "stairs"`: from `from_mm` down to `to_mm` in `count` presses, `repeats` times."""

    kind: Literal["stairs"]
    from_mm: Annotated[float, Field(gt=0.0, le=40.0)]
    """Depth of the first press."""
    to_mm: Annotated[float, Field(gt=0.0, le=40.0)]
    """Depth of the last press."""
    count: Annotated[int, Field(ge=2, le=100)]
    repeats: Annotated[int, Field(ge=1, le=100)] = 1


def planned(config: StairsConfig, layout: Layout | None = None) -> list[Planned]:
    """Every stroke exactly once, in order."""
    del layout  # the order is the point here: nothing is balanced over the sheet
    step_mm = (config.to_mm - config.from_mm) / (config.count - 1)
    depths = [config.from_mm + step_mm * number for number in range(config.count)]
    return [
        Planned(f"H{height_mm:g}-r{repeat:02d}", height_mm, 0.0, repeat, index)
        for index, (repeat, height_mm) in enumerate((r, h) for r in range(1, config.repeats + 1) for h in depths)
    ]


def steps(config: StairsConfig, layout: Layout | None = None) -> Protocol:
    """Zero touch, board, then dip, press, capture for each stroke."""
    return stroke_steps(planned(config, layout), board_every=config.board_every)
