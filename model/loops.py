"""Marks as closed loops of conic arcs in numpy, for what is drawn without gradients. No torch here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
BEZIER_PIECES = 128
"""Parabolas per side of a Bezier stroke: the error is below 1e-6 of a pixel for strokes of the default image."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """One loop: `points` (K, 3, 2) mm and `weights` (K,) as in `model.outline`, and its ends along x, mm."""

    points: Floats
    weights: Floats
    x_min_mm: float
    x_max_mm: float


def closed(*curves: Floats) -> Loop:
    """The loop of parabolas through finely sampled curves (2 N + 1, 2), joined by straight lines.

    The curves run counter-clockwise in order, and none goes farther along x than its samples.
    """
    arcs: list[Floats] = []
    for curve, following in zip(curves, (*curves[1:], curves[0]), strict=True):
        start, on, end = curve[:-1:2], curve[1::2], curve[2::2]
        arcs.append(np.stack((start, 2 * on - 0.5 * (start + end), end), axis=1))
        arcs.append(np.stack((curve[-1], 0.5 * (curve[-1] + following[0]), following[0]))[None])
    points, x = np.concatenate(arcs), np.concatenate(curves)[:, 0]
    return Loop(points, np.ones(len(points)), float(x.min()), float(x.max()))


def bezier_side(t: Any, tip: Any, base: Any, belly: Any, shoulder: Any) -> tuple[Any, Any]:
    """x and y of the Bezier stroke's upper side at t from 0 at the tip to 1 at the base; arrays or tensors.

    The cubic through (-tip, 0), (shoulder, h), (base, h), (base, 0) with h = 2/3 belly; lengths in mm.
    """
    second = shoulder * (tip + base) - tip
    return (1 - t) ** 3 * -tip + 3 * t * (1 - t) ** 2 * second + t**2 * (3 - 2 * t) * base, 2 * belly * t * (1 - t)
