"""The simulated brush of a twin: the constants that are fitted, and drawings of its presses on the captures' grid.

A constant is searched in units of its scale: 0 is the default of `BrushSpec`, 1 is one scale above it. A constant that
is never negative and may change by a factor is searched by its logarithm.

The descents of the last few brushes are remembered, because a search changes one constant at a time and half of them
leave the mechanics alone. Every press of a condition has the same seed for every brush: differences between brushes are
then not hidden by differences between presses (common random numbers).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.brush import Brush, Descent
from brushloop.drivers.sim.brush.footprint import Footprint
from brushloop.drivers.sim.brush.misfit import Misfit
from brushloop.drivers.sim.brush.spec import ALLOWED, BrushSpec
from brushloop.model.presses import DepthTilt, Grid

Vector = NDArray[np.float64]
Images = NDArray[np.float32]
FARTHEST = 6.0
"""Scales by which a constant may differ from its default."""
Place = tuple[float, float, float]
"""How much deeper each press was, and how far along x and y it touched from where the rig believes it did, mm."""
HERE: Place = (0.0, 0.0, 0.0)
PLACE_MM: Place = (0.3, 1.0, 1.0)
"""Scales of a place."""
PX_PER_MM = 5.0
"""Scale at which footprints are printed."""
INKED = 0.3
"""Density from which a place counts as inked, as in the loopback rig's own benches."""
FINE = 3
"""Each pixel of the grid is the mean of this many by this many samples."""
LEAST_MM = 0.5
REMEMBERED = 4
STILL = {"spread_wander": 0.0, "reach_wander_mm": 0.0, "bow_wander_mm": 0.0, "place_wander_mm": 0.0}
"""Values for a brush whose presses of a condition differ only by their paper."""


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
"""Constants by which presses of one condition differ."""
LEAST, MOST = np.array([*(one.bounds for one in SHAPE), *[(-FARTHEST, FARTHEST)] * len(PLACE_MM)]).T
"""Least and greatest coordinates of a point."""


def with_values(base: BrushSpec, constants: Sequence[Constant], point: Sequence[float] | Vector) -> BrushSpec:
    """`base` with these constants moved from their defaults by this many scales each."""
    return replace(base, **{one.name: one.value(float(by)) for one, by in zip(constants, point, strict=False)})


def place_at(point: Vector) -> Place:
    """The last three coordinates of a point."""
    deeper, x, y = (float(mm * v) for mm, v in zip(PLACE_MM, point[len(SHAPE) :], strict=True))
    return deeper, x, y


def reached_mm(depth_mm: float, deeper_mm: float) -> float:
    """How deep the bundle is pressed where the rig believes `depth_mm`."""
    return max(depth_mm + deeper_mm, LEAST_MM)


def draw(
    spec: BrushSpec,
    place: Place,
    conditions: Sequence[DepthTilt],
    grid: Grid,
    repeats: int = 1,
    first_seed: int = 0,
    misfit: Misfit | None = None,
) -> Images:
    """(conditions, repeats, len(y_mm), len(x_mm)) ink from 0 to 1 of a freshly dipped brush.

    Raises ValueError, naming value and range, for a press deeper than the brush allows.
    """
    brush, default = Brush(spec), BrushSpec()
    mechanics = replace(spec, seed=0, **{one.name: getattr(default, one.name) for one in (*INK, *SPREAD)})
    descents = _descents(mechanics, place[0], tuple(conditions))
    ink = np.empty((len(conditions), repeats, len(grid.y_mm), len(grid.x_mm)), np.float32)
    for c, (descent, (depth_mm, tilt_deg)) in enumerate(zip(descents, conditions, strict=True)):
        for r in range(repeats):
            seed = first_seed + 1000 * c + r
            mark = brush.print_descent(descent, ink_load=1.0, press_seed=seed, px_per_mm=PX_PER_MM)
            if misfit is not None:
                mark = misfit.bend(mark, reached_mm(depth_mm, place[0]), tilt_deg)
            ink[c, r] = _on_grid(mark, place, grid)
    return ink


@lru_cache(maxsize=REMEMBERED)
def _descents(spec: BrushSpec, deeper_mm: float, conditions: tuple[DepthTilt, ...]) -> tuple[Descent, ...]:
    """The descents of a brush with every constant that does not affect the bundle's shape at its default."""
    brush, descents = Brush(spec), dict[DepthTilt, Descent]()
    for tilt in {tilt for _, tilt in conditions}:
        reached = {depth: reached_mm(depth, deeper_mm) for depth, a in conditions if a == tilt}
        each = brush.descents(list(reached.values()), tilt)
        descents |= {(depth, tilt): each[reached_mm] for depth, reached_mm in reached.items()}
    return tuple(descents[condition] for condition in conditions)


def _on_grid(mark: Footprint, place: Place, grid: Grid) -> Images:
    """(len(y_mm), len(x_mm)) share of each pixel that the mark inks."""
    ink = (mark.density > INKED).astype(np.float32)
    fine_mm = grid.px_mm / FINE
    scale = mark.px_per_mm * fine_mm
    first_x = float(grid.x_mm[0]) - 0.5 * grid.px_mm + 0.5 * fine_mm
    first_y = float(grid.y_mm[0]) + 0.5 * grid.px_mm - 0.5 * fine_mm
    column, row = mark.origin_px
    # from a fine pixel of the grid to a pixel of the footprint, whose centres lie half a pixel from its corner
    across = column - 0.5 + (first_x - place[1]) * mark.px_per_mm
    down = row - 0.5 + (place[2] - first_y) * mark.px_per_mm
    there = np.array([[scale, 0.0, across], [0.0, scale, down]])
    size = (len(grid.x_mm), len(grid.y_mm))
    fine = cv2.warpAffine(ink, there, (FINE * size[0], FINE * size[1]), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.float32)
