"""From a character to trajectories: along the median, with the depth that gives the stroke's width there.

Convention: a point is x, y, H, alpha, heading. x and y are where the tip would meet the paper, in mm from the lower
left corner of the patch, y upward. H is the depth below the touch height. The ferrule leans by alpha toward `heading`,
counter-clockwise from x. The brush is pulled: heading is the direction of the stroke, so the ferrule leads and the
tip trails; the mark's widest place then lies at the brush axis, H tan(alpha) ahead of the point.

A stroke has phases. It begins and ends with an exposed tip where its outline comes to a point, and with a hidden tip
where it ends broadly. It turns where its median bends by at least `TURN_DEG` over one width of the stroke, and such a
turn is a folding, as in a hook, where the bend grows to `FOLD_DEG` over three widths. The terms are those of the
literature on robotic calligraphy, such as "Brush Stroke-Based Writing Trajectory Control Model for Robotic Chinese
Calligraphy", Electronics 14 (15) 3000, 2025; the rules here are our own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
"""Ink of a patch from 0 to 1, (size, size), row 0 at its far (upper) edge."""
SIDE_UNITS, FOOT_UNITS = 1024.0, -124.0
"""Side of a font's square, and its lower edge, in font units."""
TURN_DEG, FOLD_DEG = 35.0, 90.0
"""Least bend of the median of a turning and of a folding."""
POINTED = 0.5
"""An end narrower than this share of the stroke's median width is an exposed tip."""
_TABLE = 64


@dataclass(frozen=True, slots=True)
class Reach:
    """The brush's feasible range and the arm's limits along a trajectory."""

    depth_mm: tuple[float, float] = (0.5, 20.0)
    tilt_deg: tuple[float, float] = (0.0, 10.0)
    plunge: float = 1.0
    """Greatest change of depth per mm of path: 1 is a descent at 45 degrees."""
    turn_deg_mm: float = 12.0
    """Greatest turn of the wrist per mm of path: 180 deg/s at 15 mm/s."""
    wrist_deg: float = 340.0
    """Greatest absolute heading, unwrapped along a stroke."""
    apart_mm: float = 1.0
    """Least distance between neighbouring points: ARCS treats a shorter line as a turn on the spot."""

    def __post_init__(self) -> None:
        bounds = (("depth_mm", self.depth_mm), ("tilt_deg", self.tilt_deg))
        for name, (low, high) in bounds:
            if not 0 <= low < high < math.inf:
                raise ValueError(f"{name} = ({low:g}, {high:g}): expected 0 <= low < high")
        for name in ("plunge", "turn_deg_mm", "wrist_deg", "apart_mm"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"{name} = {value:g}: expected more than 0")

    def within(self, points: Floats, side_mm: float) -> Floats:
        """The feasible trajectory nearest to (N, 5) points on a patch of that side, found in one sweep each way."""
        out = points.copy()
        out[:, :2] = np.clip(out[:, :2], 0, side_mm)
        out[:, 2] = np.clip(out[:, 2], *self.depth_mm)
        out[:, 3] = np.clip(out[:, 3], *self.tilt_deg)
        out[:, 4] = np.clip(out[:, 4], -self.wrist_deg, self.wrist_deg)
        steps = np.linalg.norm(np.diff(out[:, :2], axis=0), axis=1)
        # Depth: limit it from both ends to what the neighbours allow; never press deeper than asked.
        for order in (range(1, len(out)), range(len(out) - 2, -1, -1)):
            for k in order:
                other, step = (k - 1, steps[k - 1]) if order.step == 1 else (k + 1, steps[k])
                out[k, 2] = min(out[k, 2], out[other, 2] + self.plunge * step)
        for k in range(1, len(out)):
            most = self.turn_deg_mm * steps[k - 1]
            out[k, 4] = out[k - 1, 4] + np.clip(out[k, 4] - out[k - 1, 4], -most, most)
        return out

    def spaced(self, points: Floats) -> Floats:
        """Drop points closer than `apart_mm` to the previous one, in x, y and depth; the last point stays."""
        kept = [0]
        for k in range(1, len(points)):
            if np.linalg.norm(points[k, :3] - points[kept[-1], :3]) >= self.apart_mm * 1.02:
                kept.append(k)
        if kept[-1] != len(points) - 1 and len(kept) > 1:
            kept[-1] = len(points) - 1
            while len(kept) > 2 and np.linalg.norm(points[kept[-1], :3] - points[kept[-2], :3]) < self.apart_mm * 1.02:
                del kept[-2]
        return points[kept]


@dataclass(frozen=True, slots=True)
class Patch:
    """The square patch that a character is written on: its side, and the margin around the font's square."""

    side_mm: float = 70.0
    margin_mm: float = 6.0

    def __post_init__(self) -> None:
        if not 10.0 <= self.side_mm <= 500.0 or not 0 <= self.margin_mm < 0.4 * self.side_mm:
            sizes = f"patch of {self.side_mm:g} mm with a margin of {self.margin_mm:g} mm"
            raise ValueError(f"{sizes}: expected 10 to 500 mm, the margin less than 0.4 of it")

    @property
    def mm_per_unit(self) -> float:
        """Size of a font unit in mm."""
        return (self.side_mm - 2 * self.margin_mm) / SIDE_UNITS

    def to_mm(self, units: Floats) -> Floats:
        """Font units (..., 2) to mm from the patch's lower left corner, y upward."""
        return self.margin_mm + self.mm_per_unit * (units - np.array([0.0, FOOT_UNITS]))


@dataclass(frozen=True, slots=True)
class StrokePath:
    """A path on the patch with a half width along it: `points` (N, 2) mm, `half_width_mm` (N,)."""

    points: Floats
    half_width_mm: Floats


def trajectory(path: StrokePath, model: StrokeModel, reach: Reach, patch: Patch, tilt_deg: float) -> Floats:
    """Points (N, 5) of x, y, H, alpha, heading along a path.

    The tip trails behind the axis, so the depth near the beginning is limited to keep the tip within the stroke.
    """
    points, half = path.points, path.half_width_mm
    depth = depth_of(model, reach, tilt_deg, half)
    median_mm = float(np.median(depth))
    behind = -float(model.profile(median_mm, tilt_deg).x_min_mm[0]) / median_mm
    depth = np.minimum(depth, (lengths_along(points) + half[0]) / behind)
    heading = tangents(points)
    ahead = (depth * np.tan(np.radians(tilt_deg)))[:, None]
    tip = points - ahead * directions(heading)
    return reach.within(np.column_stack((tip, depth, np.full(len(points), tilt_deg), heading)), patch.side_mm)


def depth_of(model: StrokeModel, reach: Reach, tilt_deg: float, half_width_mm: Floats) -> Floats:
    """The depths at which presses have these half widths, clipped to the feasible range, (N,) -> (N,) mm."""
    depths = np.linspace(*reach.depth_mm, _TABLE)
    widths = model.profile(depths, tilt_deg).width_mm
    return np.interp(2 * half_width_mm, np.maximum.accumulate(widths), depths)


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
    """x, y, depth and heading (N, 4) of a trajectory (N, 5): a path as `model.drag` and `model.drag` take it."""
    return np.ascontiguousarray(stroke[:, [0, 1, 2, 4]])


def grid(side_mm: float, size_px: int) -> tuple[Floats, Floats]:
    """Pixel centres of a patch, (size,) each: x from the left, y of the rows from the far edge down."""
    middle = (np.arange(size_px) + 0.5) * side_mm / size_px
    return middle, np.ascontiguousarray(side_mm - middle)


def lengths_along(points: Floats) -> Floats:
    """Length of a polyline (N, 2) up to each of its points, (N,)."""
    return np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))


def resampled(points: Floats, step_mm: float) -> Floats:
    """(N, 2) points at even steps of about `step_mm` along a polyline, both ends included; at least three."""
    along = lengths_along(points)
    count = max(3, round(along[-1] / step_mm) + 1)
    at = np.linspace(0, along[-1], count)
    return np.column_stack([np.interp(at, along, points[:, k]) for k in range(2)])


class Phase(StrEnum):
    """A part of a stroke."""

    INITIATION_HIDDEN = "initiation, hidden tip"
    INITIATION_EXPOSED = "initiation, exposed tip"
    EXECUTION = "execution"
    TURNING = "turning"
    FOLDING = "folding"
    TERMINATION_HIDDEN = "termination, hidden tip"
    TERMINATION_EXPOSED = "termination, exposed tip"


def phases_of(path: StrokePath) -> list[Phase]:
    """The phase of every point of a path.

    Initiation and termination each take one width of the stroke, but never more than a third of its length. A turning
    or folding takes half a width to both sides of its corner.
    """
    along = lengths_along(path.points)
    width_mm = 2.0 * float(np.median(path.half_width_mm))
    end_mm = min(width_mm, along[-1] / 3.0)
    heading = tangents(path.points)
    out: list[Phase] = []
    for at in along:
        if at <= end_mm:
            exposed = _pointed(path.half_width_mm[0], width_mm)
            out.append(Phase.INITIATION_EXPOSED if exposed else Phase.INITIATION_HIDDEN)
        elif at >= along[-1] - end_mm:
            exposed = _pointed(path.half_width_mm[-1], width_mm)
            out.append(Phase.TERMINATION_EXPOSED if exposed else Phase.TERMINATION_HIDDEN)
        else:
            near_deg, wide_deg = (_bend_deg(at, widths * width_mm, along, heading) for widths in (1.0, 3.0))
            turned = Phase.FOLDING if wide_deg >= FOLD_DEG else Phase.TURNING
            out.append(turned if near_deg >= TURN_DEG else Phase.EXECUTION)
    return out


def _bend_deg(at_mm: float, over_mm: float, along_mm: Floats, heading_deg: Floats) -> float:
    before, after = np.interp((at_mm - 0.5 * over_mm, at_mm + 0.5 * over_mm), along_mm, heading_deg)
    return abs(float(after - before))


def _pointed(half_width_mm: float, width_mm: float) -> bool:
    return 2.0 * half_width_mm < POINTED * width_mm


def phase_map(paths: Sequence[StrokePath], side_mm: float, size_px: int) -> NDArray[np.int64]:
    """For every pixel of a patch, the number in `list(Phase)` of the nearest point of all paths, (size, size).

    Near and far are counted from the edge of the stroke: a point's half width is taken off its distance.
    """
    order = list(Phase)
    points = np.concatenate([path.points for path in paths])
    half = np.concatenate([path.half_width_mm for path in paths])
    number = np.array([order.index(phase) for path in paths for phase in phases_of(path)])
    x, y = np.meshgrid(*grid(side_mm, size_px))
    far = np.hypot(x[..., None] - points[:, 0], y[..., None] - points[:, 1]) - half
    return number[np.argmin(far, axis=-1)]
