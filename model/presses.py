"""Presses of one brush as images around the point of touch: their sizes, and the Bezier stroke regressed on them.

At the end stands the order in which conditions are pressed.

The sizes are measured in the ink and no stroke model takes part, so what they mean does not depend on the family of the
brush.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brushloop.model.outline import Outline, as_batch
from brushloop.model.strokes import fit_plane
from brushloop.model.strokes.peers import bezier

Floats = NDArray[np.float64]
DepthTilt = tuple[float, float]
"""A condition: depth H in mm and tilt alpha in deg."""
Draw = Callable[[float, float], Outline]
"""The mark of a press by depth and tilt, x from the point of touch."""
MARGIN_MM = 2.0
SIZES = ("reach toward the tip", "reach toward the heel", "width")
"""From the point of touch to either end of the ink, and the greatest width; mm."""
FINE = 16


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixel centres of an image around the point of touch, mm: x toward the heel, y upward."""

    x_mm: Floats
    y_mm: Floats

    @property
    def px_mm(self) -> float:
        """The pixel's side."""
        return float(self.x_mm[1] - self.x_mm[0])


@dataclass(frozen=True, slots=True, eq=False)
class Presses:
    """Presses of one brush: what was commanded, and the ink."""

    radius_mm: float
    length_mm: float
    grid: Grid
    commands: Floats
    """(n, 2): depth in mm and tilt in deg."""
    ink: Floats
    """(n, len(grid.y_mm), len(grid.x_mm)) share of each pixel."""

    def __len__(self) -> int:
        return len(self.commands)

    def pick(self, rows: Sequence[int]) -> Presses:
        """The presses with these numbers."""
        return replace(self, commands=self.commands[list(rows)], ink=self.ink[list(rows)])

    @property
    def conditions(self) -> dict[DepthTilt, list[int]]:
        """Numbers of the presses of each condition, which is one depth and tilt; sorted."""
        conditions: dict[DepthTilt, list[int]] = {}
        for number, (depth_mm, tilt_deg) in enumerate(self.commands.tolist()):
            conditions.setdefault((depth_mm, tilt_deg), []).append(number)
        return dict(sorted(conditions.items()))

    @property
    def middle(self) -> DepthTilt:
        """The middle of the depths and of the tilts."""
        depth_mm, tilt_deg = (0.5 * (self.commands.min(axis=0) + self.commands.max(axis=0))).tolist()
        return depth_mm, tilt_deg

    def near_ink(self) -> Presses:
        """The presses, cut to the rows that the ink of any of them reaches, and 2 mm more."""
        inked, margin = np.flatnonzero(self.ink.any(axis=(0, 2))), round(MARGIN_MM / self.grid.px_mm)
        rows = slice(max(0, int(inked[0]) - margin), int(inked[-1]) + 1 + margin)
        return replace(self, grid=Grid(self.grid.x_mm, self.grid.y_mm[rows]), ink=self.ink[:, rows])


def measure(ink: Floats, grid: Grid) -> Floats:
    """The `SIZES` of one press, (3,); NaN without ink. The ends lie where the ink is half covered."""
    across = ink.max(axis=0)
    if not (across > 0.5).any():
        return np.full(len(SIZES), np.nan)
    tip, heel = _end(across, grid.x_mm), _end(across[::-1], grid.x_mm[::-1])
    return np.array([-tip, heel, ink.sum(axis=0).max() * grid.px_mm])


def _end(across: Floats, x_mm: Floats) -> float:
    """Where ink begins, between the centres of two pixels."""
    k = int(np.argmax(across > 0.5))
    if k == 0:
        return float(x_mm[0])
    share = (0.5 - across[k - 1]) / (across[k] - across[k - 1])
    return float(x_mm[k - 1] + share * (x_mm[k] - x_mm[k - 1]))


def plane_at(commands: Floats, measured: Floats, at: DepthTilt) -> Floats:
    """(3, 3): each size (column) at a depth and tilt, its growth by mm of depth and by degree of tilt, from a plane.

    `measured` (n, 3) are the `SIZES` at the commands (n, 2). Raises ValueError if these do not span depth and tilt.
    """
    plane = fit_plane(commands[:, 0], commands[:, 1], dict(zip(SIZES, measured.T, strict=True)))
    depth, tilt = at
    rows = [list(plane.at(*command).values()) for command in ((depth, tilt), (depth + 1.0, tilt), (depth, tilt + 1.0))]
    return np.array([rows[0], np.subtract(rows[1], rows[0]), np.subtract(rows[2], rows[0])])


def refit_bezier(presses: Presses) -> Draw | None:
    """The paper's Bezier baseline: ends, belly and shoulder of the marks as planes in (H, H alpha).

    None where a press holds no ink, or the conditions are too few for a plane.
    """
    grid, rows = presses.grid, list[tuple[float, float, float, float]]()
    for ink in presses.ink:
        columns = np.flatnonzero((ink > 0.5).any(axis=0))
        if not len(columns):
            return None
        left = float(grid.x_mm[columns[0]]) - 0.5 * grid.px_mm
        right = float(grid.x_mm[columns[-1]]) + 0.5 * grid.px_mm
        width = float(ink.sum(axis=0).max()) * grid.px_mm
        # The enclosed area is belly length (4 - s) / 5, as in `model.strokes.peers.bezier_sizes`.
        area = float(ink.sum()) * grid.px_mm**2
        rows.append((left, right, width, float(np.clip(4.0 - 5.0 * area / (width * (right - left)), 0.0, 1.0))))
    names = "left_mm", "right_mm", "belly_mm", "shoulder"
    try:
        depths_mm, tilts_deg = presses.commands[:, 0], presses.commands[:, 1]
        plane = fit_plane(depths_mm, tilts_deg, dict(zip(names, np.array(rows).T, strict=True)))
    except ValueError:
        return None

    def outline(depth_mm: float, tilt_deg: float) -> Outline:
        left, right, belly, shoulder = plane.at(depth_mm, tilt_deg).values()
        right, belly, shoulder = max(right, left + 0.2), max(belly, 0.1), min(max(shoulder, 0.0), 1.0)
        return bezier(*as_batch(-left, right, belly, shoulder))

    return outline


def image_of(mark: Outline, grid: Grid) -> Floats:
    """Coverage (len(y_mm), len(x_mm)) of a mark with one upper and one lower edge, sampled at `FINE` places a column.

    The compiled raster would be exact, but takes longer to load than all marks of a fit take to draw.
    """
    points = mark.polyline()[0]
    points = np.roll(points, -int(points[:, 0].argmin()), axis=0)  # from the tip along the lower edge, and back
    heel = int(points[:, 0].argmax())
    x_mm = (grid.x_mm[:, None] + grid.px_mm * ((np.arange(FINE) + 0.5) / FINE - 0.5)).ravel()
    lower, upper = points[: heel + 1], np.concatenate([points[heel:], points[:1]])[::-1]
    below, above = (np.interp(x_mm, edge[:, 0], edge[:, 1], left=0.0, right=0.0) for edge in (lower, upper))
    bottom_mm = grid.y_mm[:, None] - 0.5 * grid.px_mm
    inside = np.clip(above - bottom_mm, 0.0, grid.px_mm) - np.clip(below - bottom_mm, 0.0, grid.px_mm)
    return inside.reshape(len(grid.y_mm), -1, FINE).mean(axis=2) / grid.px_mm


def farthest_first(places: Floats, first: int, count: int) -> list[int]:
    """Rows of (n, d) `places`, from the row `first`, each as far as possible from those before; `count` is at most n.

    A maximin design that can stop anywhere, after R. Kennard and L. Stone, "Computer aided design of experiments"
    (1969). Of equally distant rows the upper one comes first.
    """
    order, nearest = [first], np.full(len(places), np.inf)
    while len(order) < count:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[order[-1]], axis=1))
        nearest[order] = -1.0
        order.append(int(np.round(nearest, 9).argmax()))
    return order


def spread_out(depths_mm: Sequence[float], tilts_deg: Sequence[float]) -> list[DepthTilt]:
    """Every condition once, each as far as possible from those before it: the first few describe any brush well.

    Both axes are scaled to the range of the grid. The first condition is the shallowest at the least tilt.
    """
    conditions = list(itertools.product(depths_mm, tilts_deg))
    places = np.array(conditions)
    range_of = np.ptp(places, axis=0)
    places = (places - places.min(axis=0)) / np.where(range_of > 0.0, range_of, 1.0)
    return [conditions[k] for k in farthest_first(places, conditions.index(min(conditions)), len(conditions))]
