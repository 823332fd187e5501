"""The constants of the simulated brush that a twin fits, and how far each may lie from its default.

A constant is searched in units of its scale: 0 is the default of `BrushSpec`, 1 is one scale above it. A constant that
is never negative and may change by a factor is searched by its logarithm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.spec import ALLOWED, BrushSpec

Vector = NDArray[np.float64]
FARTHEST = 6.0
"""Scales by which a constant may differ from its default."""
OFFSETS_MM = (0.3, 1.0, 1.0)
"""Scales of the differences in depth, x and y between where the brush touched and where the rig believes it did."""


@dataclass(frozen=True, slots=True)
class Constant:
    """One searched constant; `scale` is what is plausible between brushes, relative if `factor`."""

    name: str
    unit: str
    scale: float
    factor: bool = False

    @property
    def default(self) -> float:
        """The constant of the default brush."""
        return float(getattr(BrushSpec(), self.name))

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest value in scales from the default."""
        low, high = (self.scales(max(end, 1e-9) if self.factor else end) for end in ALLOWED[self.name])
        return max(low, -FARTHEST), min(high, FARTHEST)

    def value(self, scales: float) -> float:
        """The value that lies this many scales from the default, within what `BrushSpec` allows."""
        moved = self.default * math.exp(self.scale * scales) if self.factor else self.default + self.scale * scales
        low, high = ALLOWED[self.name]
        return min(max(moved, low), high)

    def scales(self, value: float) -> float:
        """How many scales a value lies from the default."""
        return math.log(value / self.default) / self.scale if self.factor else (value - self.default) / self.scale


MECHANICS = (
    Constant("stiffness_n_mm2", "N mm^2", 0.5, factor=True),
    Constant("stiffness_power", "", 0.4),
    Constant("squash_n_per_mm2", "N/mm^2", 0.5, factor=True),
    Constant("suction_n_per_mm2", "N/mm^2", 0.0015),
    Constant("friction", "", 0.08),
    Constant("set_deg", "deg", 4.0),
    Constant("belly_share", "", 0.1),
    Constant("taper_power", "", 0.25, factor=True),
)
"""Constants that bend and shape the bundle: the spine must be solved again when one of these changes."""
INK = (
    Constant("splay_power", "", 0.5),
    Constant("film_mm", "mm", 0.4, factor=True),
    Constant("wick_mm", "mm", 0.4, factor=True),
    Constant("need_per_mm2", "1/mm^2", 0.5, factor=True),
    Constant("uneven_mm", "mm", 2.0),
    Constant("trail_share", "", 0.3),
    Constant("bow_mm", "mm", 0.25),
)
"""Constants that decide where the hairs of a solved spine lay ink."""
SHAPE = MECHANICS + INK
SPREAD = (
    Constant("spread_wander", "", 0.7, factor=True),
    Constant("reach_wander_mm", "mm", 0.7, factor=True),
    Constant("bow_wander_mm", "mm", 0.7, factor=True),
    Constant("place_wander_mm", "mm", 0.2),
    Constant("strand_mm", "mm", 0.7, factor=True),
)
"""Constants by which presses of one cell differ."""


@dataclass(frozen=True, slots=True)
class Offset:
    """Difference between where the brush really touched and where the rig believes that it did, mm."""

    depth_mm: float
    """How much deeper each press was."""
    x_mm: float
    y_mm: float


def brush_at(point: Vector, base: BrushSpec) -> BrushSpec:
    """The brush at a point (len(SHAPE) + 3,) of the search, with the size and the individual of `base`."""
    return with_values(base, SHAPE, point)


def with_values(base: BrushSpec, constants: Sequence[Constant], point: Sequence[float] | Vector) -> BrushSpec:
    """`base` with these constants moved from their defaults by this many scales each."""
    values = {one.name: one.value(float(scales)) for one, scales in zip(constants, point, strict=False)}
    return replace(base, **values)


def offset_at(point: Vector) -> Offset:
    """The last three coordinates of a point."""
    depth, x, y = (mm * float(v) for mm, v in zip(OFFSETS_MM, point[len(SHAPE) :], strict=True))
    return Offset(depth, x, y)


def search_bounds() -> tuple[Vector, Vector]:
    """Least and greatest coordinates of a point."""
    ends = [one.bounds for one in SHAPE] + [(-FARTHEST, FARTHEST)] * 3
    low, high = zip(*ends, strict=True)
    return np.array(low), np.array(high)
