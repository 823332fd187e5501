"""How far an approach may go: around what is expected, and wider where less is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

from collect.config import PaperConfig
from collect.touch.config import TouchConfig


@dataclass(frozen=True, slots=True)
class Reach:
    """Where a slow approach begins, what is expected, and where it ends: heights in the base frame."""

    start_z_mm: float
    expected_z_mm: float
    lowest_z_mm: float


class Known:
    """The heights that are known so far: at first the taught one, at the place where it was taught."""

    def __init__(self, paper: PaperConfig, config: TouchConfig) -> None:
        self._config = config
        self._heights = [(*paper.touch_point_mm, paper.touch_z_mm)]

    def add(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """A touch."""
        self._heights.append((x_mm, y_mm, z_mm))

    def reach(self, x_mm: float, y_mm: float, extent_mm: float = 0.0) -> Reach:
        """Around the height that is known nearest, by as much more as the sheet may lean on the way from there.

        `extent_mm` is how far from the point the touches of its approach may lie.
        """
        away_mm, z_mm = min((math.dist((x_mm, y_mm), (x, y)), z) for x, y, z in self._heights)
        unknown_mm = math.tan(math.radians(self._config.lean_deg)) * (away_mm + extent_mm)
        return Reach(z_mm + self._config.above_mm + unknown_mm, z_mm, z_mm - self._config.travel_mm - unknown_mm)
