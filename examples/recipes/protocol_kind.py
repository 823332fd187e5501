"""A kind of protocol: one press after the other, each a little deeper, as often as asked.

Put such a class into a file of `collect/protocols/` and into the union `ProtocolConfig` in `config.py` there. Reading
it from `protocol.toml`, limits, plan, steps, resume, screen and recording then work as for every other kind.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from brushloop.collect.protocols.kinds import DeepMm, RoundsConfig
from brushloop.collect.protocols.steps import Planned
from brushloop.sessions.records import Condition


class StairsConfig(RoundsConfig):
    """`kind = "stairs"`: from `from_mm` to `to_mm` in `count` presses, `repeats` times."""

    kind: Literal["stairs"]
    from_mm: DeepMm
    """Depth of the first press."""
    to_mm: DeepMm
    """Depth of the last press."""
    count: int = Field(ge=2, le=100)
    """Presses of one round."""

    def round(self, repeat: int) -> list[Planned]:
        """The presses of round `repeat`, counted from 1, in order; with a seed they are shuffled afterwards."""
        step_mm = (self.to_mm - self.from_mm) / (self.count - 1)
        depths_mm = [self.from_mm + step_mm * number for number in range(self.count)]
        return [Planned(f"H{depth_mm:g}-r{repeat:02d}", Condition(depth_mm, 0.0)) for depth_mm in depths_mm]
