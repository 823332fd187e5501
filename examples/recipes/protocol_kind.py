"""A kind of protocol: one press after the other, each a little deeper, as often as asked.

Put such a class into a file of `collect/protocols/` and into the union `ProtocolConfig` in `config.py` there. Reading
it from `protocol.toml`, limits, plan, steps, resume, screen and recording then work as for every other kind.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from brushloop.collect.protocols.plan import DeepMm, Planned, ProtocolBase, Repeats, check_count
from brushloop.collect.rig.paper import Layout
from brushloop.sessions.records import Condition


class StairsConfig(ProtocolBase):
    """`kind = "stairs"`: from `from_mm` to `to_mm` in `count` presses, `repeats` times."""

    depths_field: ClassVar[str] = "from_mm, to_mm"

    kind: Literal["stairs"]
    from_mm: DeepMm
    """Depth of the first press."""
    to_mm: DeepMm
    """Depth of the last press."""
    count: int = Field(ge=2, le=100)
    """Presses of one round."""
    repeats: Repeats = 1
    """Rounds."""

    @model_validator(mode="after")
    def _bounded(self) -> StairsConfig:
        check_count(self.count * self.repeats)
        return self

    def planned(self, layout: Layout | None = None) -> list[Planned]:
        """Every stroke exactly once, in order; the order is the point here, so nothing is spread over the sheet."""
        step_mm = (self.to_mm - self.from_mm) / (self.count - 1)
        depths_mm = [self.from_mm + step_mm * number for number in range(self.count)]
        rounds = [(repeat, depth_mm) for repeat in range(1, self.repeats + 1) for depth_mm in depths_mm]
        return [
            Planned(f"H{depth_mm:g}-r{repeat:02d}", Condition(depth_mm, 0.0), repeat, index)
            for index, (repeat, depth_mm) in enumerate(rounds)
        ]
