"""The phases of a stroke: how it begins, what is drawn, where it turns or folds, and how it ends.

A stroke begins and ends with an exposed tip where its outline comes to a point, and with a hidden tip where it ends
broadly. It turns where its median bends by at least `TURN_DEG` over one width of the stroke, and such a turn is a
folding, as in a hook, where the bend grows to `FOLD_DEG` over three widths. The terms are those of the literature on
robotic calligraphy, such as "Brush Stroke-Based Writing Trajectory Control Model for Robotic Chinese Calligraphy",
Electronics 14 (15) 3000, 2025; the rules here are our own.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from brushloop.model.characters.plan import Path, grid, tangents

Floats = NDArray[np.float64]
TURN_DEG, FOLD_DEG = 35.0, 90.0
"""Least bend of the median of a turning and of a folding."""
POINTED = 0.5
"""An end narrower than this share of the stroke's median width is an exposed tip."""


class Phase(StrEnum):
    """A part of a stroke."""

    INITIATION_HIDDEN = "initiation, hidden tip"
    INITIATION_EXPOSED = "initiation, exposed tip"
    EXECUTION = "execution"
    TURNING = "turning"
    FOLDING = "folding"
    TERMINATION_HIDDEN = "termination, hidden tip"
    TERMINATION_EXPOSED = "termination, exposed tip"


def phases_of(path: Path) -> list[Phase]:
    """The phase of every point of a path.

    Initiation and termination each take one width of the stroke, but never more than a third of its length. A turning
    or folding takes half a width to both sides of its corner.
    """
    steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
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


def phase_map(paths: Sequence[Path], side_mm: float, size_px: int) -> NDArray[np.int64]:
    """For every pixel of a cell, the number in `list(Phase)` of the nearest point of all paths, (size, size).

    Near and far are counted from the edge of the stroke: a point's half width is taken off its distance.
    """
    order = list(Phase)
    points = np.concatenate([path.points for path in paths])
    half = np.concatenate([path.half_width_mm for path in paths])
    number = np.array([order.index(phase) for path in paths for phase in phases_of(path)])
    x, y = np.meshgrid(*grid(side_mm, size_px))
    far = np.hypot(x[..., None] - points[:, 0], y[..., None] - points[:, 1]) - half
    return number[np.argmin(far, axis=-1)]
