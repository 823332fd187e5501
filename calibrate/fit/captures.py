"""The data of a fit: the presses of a session as images around the point of touch, and the sizes of their marks.

Each size of each press is measured in its ink, and a plane over depth and tilt is fitted to it. No stroke model takes
part, so what a number means does not depend on the family of the brush. The intervals are those of the jackknife: each
cell is left out in turn, so they hold the differences between presses and how far the brush is from a plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate import presses
from brushloop.calibrate.compare import ANCHOR_MM, MM_PER_PX, SIZE_PX, brush_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.presses import Refused, cut, uncommanded
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.stats import student_95
from brushloop.model.strokes import fit_plane
from brushloop.sessions.terminal import Progress, unseen

Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""H and alpha."""

SPREAD_MM = 0.15
"""Variation of an edge from press to press (scale of a logistic)."""
MARGIN_MM = 2.0
SIZES = ("reach toward the tip", "reach toward the heel", "width")
"""From the point of touch to either end of the ink, and the greatest width; mm."""
FEWEST_CELLS = 5


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixel centres of an image around the point of touch, mm: x toward the heel, y upward."""

    x_mm: Floats
    y_mm: Floats

    @property
    def px_mm(self) -> float:
        """The pixel's side."""
        return float(self.x_mm[1] - self.x_mm[0])


@dataclass(frozen=True, slots=True)
class Pressed:
    """One captured press: its command and its ink, (len(y_mm), len(x_mm)) from 0 to 1."""

    depth_mm: float
    tilt_deg: float
    ink: NDArray[np.floating]


def pressed(press: presses.Press) -> Pressed:
    """A press of a session, as a fit uses it."""
    return Pressed(press.condition.depth_mm, press.condition.tilt_deg, np.asarray(press.coverage, np.float64))


def by_cell(strokes: Sequence[Pressed]) -> dict[Cell, list[Pressed]]:
    """The strokes of each (H, alpha)."""
    cells: dict[Cell, list[Pressed]] = {}
    for stroke in strokes:
        cells.setdefault((stroke.depth_mm, stroke.tilt_deg), []).append(stroke)
    return dict(sorted(cells.items()))


@dataclass(frozen=True, slots=True)
class Captures:
    """The presses that a fit uses, and where they come from."""

    session: OpenSession
    radius_mm: float
    length_mm: float
    grid: Grid
    strokes: list[Pressed]
    refused: list[Refused]
    """Captures that cannot be used or are cut by the edge of their photograph."""


def field_grid() -> Grid:
    """The pixel centres of the millimetre field around the point of touch."""
    left, top = ANCHOR_MM
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * MM_PER_PX, np.float64)
    return Grid(np.asarray(centres - left), np.asarray(top - centres))


def read_presses(session: Path, progress: Progress = unseen) -> Captures:
    """Read every usable press of a session. Raises `CalibrationError` where it holds none, or was not calibrated."""
    opened = open_session(session, "press")
    refused: list[Refused] = []
    usable = presses.read_presses(opened, refused, uncommanded, cut, progress=progress)
    strokes = [pressed(press) for press in usable]
    if not strokes:
        raise CalibrationError(str(opened.recording.path), "holds no press that can be used for a fit")
    brush = brush_of(opened.header)
    return Captures(opened, float(brush.radius_mm), float(brush.length_mm), field_grid(), strokes, refused)


def near_ink(strokes: Sequence[Pressed], grid: Grid) -> tuple[list[Pressed], Grid]:
    """Strokes and grid, cut to the rows that the ink of any stroke reaches, and 2 mm more."""
    inked = np.flatnonzero(np.any([stroke.ink.any(axis=1) for stroke in strokes], axis=0))
    margin = round(MARGIN_MM / grid.px_mm)
    rows = slice(max(0, int(inked[0]) - margin), int(inked[-1]) + 1 + margin)
    return [replace(stroke, ink=stroke.ink[rows]) for stroke in strokes], Grid(grid.x_mm, grid.y_mm[rows])


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
