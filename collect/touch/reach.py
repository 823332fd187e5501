"""How far an approach may go: around what is expected, and wider where less is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

from collect.rig.config import PaperConfig
from collect.rig.config_touch import TouchConfig


@dataclass(frozen=True, slots=True)
class Reach:
    """Where a slow approach begins, what is expected, and where it ends: heights in the base frame."""

    start_z_mm: float
    expected_z_mm: float
    lowest_z_mm: float


def lowest_z_mm(paper: PaperConfig, config: TouchConfig, x_mm: float, y_mm: float, extent_mm: float = 0.0) -> float:
    """No touch goes below this, whatever those before it found: the end of an approach from the taught height.

    A plan can only be checked against heights that are known before anything was touched.
    """
    return paper.touch_z_mm - config.travel_mm - _unknown_mm(config, paper.touch_point_mm, x_mm, y_mm, extent_mm)


class Known:
    """The heights that are known so far: at first the taught one, at the place where it was taught."""

    def __init__(self, paper: PaperConfig, config: TouchConfig) -> None:
        self._paper = paper
        self._config = config
        self._heights = [(paper.touch_point_mm, paper.touch_z_mm)]

    def add(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """A touch."""
        self._heights.append(((x_mm, y_mm), z_mm))

    def reach(self, x_mm: float, y_mm: float, extent_mm: float = 0.0) -> Reach:
        """Around the height that is known nearest, by as much more as the sheet may lean on the way from there.

        `extent_mm` is how far from the point the touches of its approach may lie.
        """
        place, z_mm = min(self._heights, key=lambda known: math.dist((x_mm, y_mm), known[0]))
        unknown_mm = _unknown_mm(self._config, place, x_mm, y_mm, extent_mm)
        lowest_mm = lowest_z_mm(self._paper, self._config, x_mm, y_mm, extent_mm)
        return Reach(
            z_mm + self._config.above_mm + unknown_mm,
            z_mm,
            max(z_mm - self._config.travel_mm - unknown_mm, lowest_mm),
        )


def _unknown_mm(
    config: TouchConfig, known_mm: tuple[float, float], x_mm: float, y_mm: float, extent_mm: float
) -> float:
    """How much the sheet may rise or fall from a place where its height is known."""
    return math.tan(math.radians(config.lean_deg)) * (math.dist((x_mm, y_mm), known_mm) + extent_mm)
