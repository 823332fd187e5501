"""Limits of brush and arm along a trajectory, and the depth that gives a stroke width.

Convention: a point is x, y, H, alpha, heading. x and y are where the tip would meet the paper, in mm from the lower
left corner of the cell, y upward. H is the depth below the touch height. The ferrule leans by alpha toward `heading`,
counter-clockwise from x. The brush is pulled: heading is the direction of the stroke, so the ferrule leads and the
tip trails; the mark's widest place then lies at the brush axis, H tan(alpha) ahead of the point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.model.drag import DragModel
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
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
        """The feasible trajectory nearest to (N, 5) points on a cell of that side, found in one sweep each way."""
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


def depth_of(model: StrokeModel, reach: Reach, tilt_deg: float, half_width_mm: Floats) -> Floats:
    """The depths at which presses have these half widths, clipped to the feasible range, (N,) -> (N,) mm."""
    heights = np.linspace(*reach.depth_mm, _TABLE)
    widths = model.profile(heights, tilt_deg).width_mm
    return np.interp(2 * half_width_mm, np.maximum.accumulate(widths), heights)


def dragged_depth_of(drag: DragModel, reach: Reach, half_width_mm: Floats) -> Floats:
    """The depths at which dragged marks have these half widths, (N,) -> (N,) mm."""
    heights = np.linspace(*reach.depth_mm, _TABLE)
    half = drag.half_mm + drag.half_per_mm * heights + drag.half_per_mm2 * heights**2
    return np.interp(half_width_mm, np.maximum.accumulate(half), heights)


def behind_of(model: StrokeModel, tilt_deg: float, depth_mm: float) -> float:
    """How far a mark extends behind the brush axis, per mm of depth."""
    return -float(model.profile(depth_mm, tilt_deg).x_min_mm[0]) / depth_mm
