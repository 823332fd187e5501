"""From a character to trajectories: along the median, with the depth that gives the stroke's width there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.model.characters.brush import Reach, behind_of, depth_of, dragged_depth_of
from brushloop.model.characters.glyph import FOOT_UNITS, SIDE_UNITS, Glyph
from brushloop.model.drag import DragModel
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Cell:
    """The square patch that a character is written on: its side, and the margin around the font's square."""

    side_mm: float = 70.0
    margin_mm: float = 6.0

    def __post_init__(self) -> None:
        if not 10.0 <= self.side_mm <= 500.0 or not 0 <= self.margin_mm < 0.4 * self.side_mm:
            given = f"cell of {self.side_mm:g} mm with a margin of {self.margin_mm:g} mm"
            raise ValueError(f"{given}: expected 10 to 500 mm, the margin less than 0.4 of it")

    @property
    def mm_per_unit(self) -> float:
        """Size of a font unit in mm."""
        return (self.side_mm - 2 * self.margin_mm) / SIDE_UNITS

    def to_mm(self, units: Floats) -> Floats:
        """Font units (..., 2) to mm from the cell's lower left corner, y upward."""
        return self.margin_mm + self.mm_per_unit * (units - np.array([0.0, FOOT_UNITS]))


@dataclass(frozen=True, slots=True)
class Path:
    """A path on the cell with a half width along it: `points` (N, 2) mm, `half_width_mm` (N,)."""

    points: Floats
    half_width_mm: Floats


def paths_of(glyph: Glyph, cell: Cell, step_mm: float) -> list[Path]:
    """The medians of a character, resampled, each with its distance to the stroke's outline."""
    out: list[Path] = []
    for stroke in glyph.strokes:
        points = resampled(cell.to_mm(stroke.median), step_mm)
        out.append(Path(points, distance_to(cell.to_mm(stroke.polyline()), points)))
    return out


def trajectory(
    path: Path, model: StrokeModel, reach: Reach, cell: Cell, tilt_deg: float, drag: DragModel | None = None
) -> Floats:
    """Points (N, 5) of x, y, H, alpha, heading along a path; the convention is in `model.characters.brush`.

    The tip trails behind the axis, so the depth near the beginning is limited to keep the tip within the stroke. With
    `drag`, depths are those at which a dragged mark has the wanted width.
    """
    points, half = path.points, path.half_width_mm
    height = depth_of(model, reach, tilt_deg, half) if drag is None else dragged_depth_of(drag, reach, half)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    back = behind_of(model, tilt_deg, float(np.median(height)))
    height = np.minimum(height, (along + half[0]) / back)
    heading = tangents(points)
    ahead = (height * np.tan(np.radians(tilt_deg)))[:, None]
    made = np.column_stack((points - ahead * directions(heading), height, np.full(len(points), tilt_deg), heading))
    return reach.within(made, cell.side_mm)


def tangents(points: Floats) -> Floats:
    """Headings in degrees along (N, 2) points, counter-clockwise from x, unwrapped, the first within 180 of 0."""
    ahead = np.diff(points, axis=0)
    middle = np.concatenate((ahead[:1], ahead[1:] + ahead[:-1], ahead[-1:]))
    return np.degrees(np.unwrap(np.arctan2(middle[:, 1], middle[:, 0])))


def directions(heading_deg: Floats) -> Floats:
    """Unit vectors (N, 2) of headings (N,) in degrees, counter-clockwise from x."""
    turn = np.radians(heading_deg)
    return np.column_stack((np.cos(turn), np.sin(turn)))


def without_tilt(stroke: Floats) -> Floats:
    """x, y, depth and heading (N, 4) of a trajectory (N, 5): a path as `model.footprint` and `model.drag` take it."""
    return np.ascontiguousarray(stroke[:, [0, 1, 2, 4]])


def grid(side_mm: float, size_px: int) -> tuple[Floats, Floats]:
    """Pixel centres of a cell, (size,) each: x from the left, y of the rows from the far edge down."""
    middle = (np.arange(size_px) + 0.5) * side_mm / size_px
    return middle, np.ascontiguousarray(side_mm - middle)


def resampled(points: Floats, step_mm: float) -> Floats:
    """(N, 2) points at even steps of about `step_mm` along a polyline, both ends included; at least three."""
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    count = max(3, round(along[-1] / step_mm) + 1)
    at = np.linspace(0, along[-1], count)
    return np.column_stack([np.interp(at, along, points[:, k]) for k in range(2)])


def distance_to(loop: Floats, points: Floats) -> Floats:
    """The distance of (N, 2) points to a closed polyline (M, 2), (N,); 0 outside it."""
    start, end = loop, np.roll(loop, -1, axis=0)
    side = end - start
    length = np.maximum(np.sum(side**2, axis=1), 1e-18)
    off = points[:, None] - start
    share = np.clip(np.sum(off * side, axis=2) / length, 0, 1)
    nearest = np.linalg.norm(off - share[..., None] * side, axis=2).min(axis=1)
    x, y = points[:, :1], points[:, 1:]
    crosses = (start[:, 1] > y) != (end[:, 1] > y)
    rise = np.where(side[:, 1] == 0, 1.0, side[:, 1])
    left = x < start[:, 0] + (y - start[:, 1]) / rise * side[:, 0]
    inside = np.count_nonzero(crosses & left, axis=1) % 2 == 1
    return np.where(inside, nearest, 0.0)
