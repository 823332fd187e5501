"""Sizes of the marks: how far they reach and how wide they are, how that grows, and 95 % intervals.

Each size of each press is measured in its ink, and a plane over depth and tilt is fitted to it. No stroke model takes
part, so what a number means does not depend on the family of the brush. The intervals are those of the jackknife: each
cell is left out in turn, so they hold the differences between presses and how far the brush is from a plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brushloop.calibrate.fit.captures import Floats, Grid, Pressed, by_cell
from brushloop.calibrate.stats import student_95
from brushloop.model.strokes import fit_plane

SIZES = ("reach toward the tip", "reach toward the heel", "width")
"""From the point of touch to either end of the ink, and the greatest width; mm."""
FEWEST_CELLS = 5


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, variance: float, factor: float) -> Estimate:
        """The interval of `factor` standard errors on either side."""
        off = factor * math.sqrt(variance)
        return cls(value, value - off, value + off)

    def __str__(self) -> str:
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"


@dataclass(frozen=True, slots=True)
class Size:
    """One size of the marks in the middle of the session's depths and tilts."""

    name: str
    here: Estimate
    """mm"""
    by_depth: Estimate
    """mm per mm of depth"""
    by_tilt: Estimate
    """mm per degree of tilt"""


def measure(stroke: Pressed, grid: Grid) -> Floats:
    """The `SIZES` of one press, (3,); NaN without ink. The ends lie where the ink is half covered."""
    across = stroke.ink.max(axis=0)
    if not (across > 0.5).any():
        return np.full(len(SIZES), np.nan)
    tip, heel = _end(across, grid.x_mm), _end(across[::-1], grid.x_mm[::-1])
    return np.array([-tip, heel, stroke.ink.sum(axis=0).max() * grid.px_mm])


def middle(strokes: Sequence[Pressed]) -> tuple[float, float]:
    """The middle of the depths and of the tilts."""
    depths, tilts = [s.depth_mm for s in strokes], [s.tilt_deg for s in strokes]
    return 0.5 * (min(depths) + max(depths)), 0.5 * (min(tilts) + max(tilts))


def sizes_of(strokes: Sequence[Pressed], grid: Grid) -> list[Size]:
    """Every size; empty where the cells are too few for an interval, or do not span depth and tilt without one."""
    inked = [stroke for stroke in strokes if (stroke.ink > 0.5).any()]
    cells = list(by_cell(inked))
    if len(cells) < FEWEST_CELLS:
        return []
    at, measured = middle(inked), np.array([measure(stroke, grid) for stroke in inked])
    keys = np.array([cells.index((stroke.depth_mm, stroke.tilt_deg)) for stroke in inked])
    try:
        whole = plane_at(inked, measured, at)
        others = [np.flatnonzero(keys != k) for k in range(len(cells))]
        without = np.array([plane_at([inked[row] for row in rows], measured[rows], at) for rows in others])
    except ValueError:
        return []
    variance = (1.0 - 1.0 / len(cells)) * ((without - whole) ** 2).sum(axis=0)
    factor = student_95(len(cells) - 1)
    return [
        Size(name, *(Estimate.of(float(v), float(s), factor) for v, s in zip(values, squares, strict=True)))
        for name, values, squares in zip(SIZES, whole.T, variance.T, strict=True)
    ]


def plane_at(strokes: Sequence[Pressed], measured: Floats, at: tuple[float, float]) -> Floats:
    """(3, 3): each size (column) at a depth and tilt, its growth by mm of depth and by degree of tilt, from a plane.

    Raises ValueError if the cells do not span depth and tilt.
    """
    plane = fit_plane(
        [s.depth_mm for s in strokes], [s.tilt_deg for s in strokes], dict(zip(SIZES, measured.T, strict=True))
    )
    depth, tilt = at
    rows = [list(plane.at(*command).values()) for command in ((depth, tilt), (depth + 1.0, tilt), (depth, tilt + 1.0))]
    return np.array([rows[0], np.subtract(rows[1], rows[0]), np.subtract(rows[2], rows[0])])


def _end(across: Floats, x_mm: Floats) -> float:
    """Where ink begins, between the centres of two pixels."""
    k = int(np.argmax(across > 0.5))
    if k == 0:
        return float(x_mm[0])
    share = (0.5 - across[k - 1]) / (across[k] - across[k - 1])
    return float(x_mm[k - 1] + share * (x_mm[k] - x_mm[k - 1]))
