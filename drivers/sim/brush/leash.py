"""Where the contact patch of a dragged brush goes: it trails the commanded tip on a leash and turns when pulled."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.sim.brush.spine import Vector

STEP_MM = 0.3
"""Longest way of the commanded tip between two moments of a drag."""

SHORTEST = 0.3
"""Length of a patch that is pulled square across, as a share of its full length."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point of the commanded tip's path, in the paper frame; depth is positive below the paper plane."""

    x_mm: float
    y_mm: float
    depth_mm: float


@dataclass(frozen=True, slots=True)
class Reach:
    """How far behind the commanded tip the patch lies, by depth; (k,) each."""

    depth_mm: Vector
    pressed_mm: Vector
    """From the tip to the middle of the patch when the brush only came down."""
    pulled_mm: Vector
    """The same while it is drawn along: the length of the leash."""
    half_mm: Vector
    """Half the length of the patch."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The patch at one moment of a drag."""

    x_mm: float
    y_mm: float
    """Its middle, in the frame of the path."""
    heading_rad: float
    """Direction from the tip of the hairs to the ferrule."""
    length: float
    """Factor on its length."""
    depth_mm: float
    travel_mm: float
    """Sideways way of the commanded tip until then."""
    pulled: bool
    """True once the leash has come taut."""


def follow(path: Sequence[Waypoint], reach: Reach, heading_rad: float) -> list[Moment]:
    """Draw the patch along the path on its leash.

    While the brush comes down, its tip slides away from the ferrule and takes the middle of the patch along. The patch
    stays where it is until the leash is taut, then follows straight toward the commanded tip. It turns like a stick
    that is pulled at its middle, over half its own length; pulled across, the hairs stand up and the patch is short.
    """
    x, y, depth = _samples(path)
    pressed, pulled, half = (
        np.interp(depth, reach.depth_mm, v) for v in (reach.pressed_mm, reach.pulled_mm, reach.half_mm)
    )
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    px, py = float(x[0]), float(y[0])
    heading, taut = heading_rad, False
    moments: list[Moment] = []
    for k in range(x.size):
        slid = float(pressed[k] - (pressed[k - 1] if k else 0.0))
        if k == 0 or depth[k] > depth[k - 1]:
            px -= slid * math.cos(heading)
            py -= slid * math.sin(heading)
        dx, dy = float(x[k]) - px, float(y[k]) - py
        short, askew = math.hypot(dx, dy) - float(pulled[k]), 0.0
        if short > 0.0:
            toward = math.atan2(dy, dx)
            px += short * math.cos(toward)
            py += short * math.sin(toward)
            askew = math.remainder(toward - heading, math.tau) * math.exp(-short / max(float(half[k]), STEP_MM))
            heading, taut = toward - askew, True
        length = max(SHORTEST, abs(math.cos(askew)))
        moments.append(Moment(px, py, heading, length, float(depth[k]), float(travel[k]), taut))
    return moments


def _samples(path: Sequence[Waypoint]) -> tuple[Vector, Vector, Vector]:
    """x, y, depth (n,) of the commanded tip, at most `STEP_MM` apart, corners included."""
    corners = np.array([(w.x_mm, w.y_mm, w.depth_mm) for w in path])
    pieces = [corners[:1]]
    for a, b in itertools.pairwise(corners):
        count = max(1, math.ceil(float(np.linalg.norm(b - a)) / STEP_MM))
        pieces.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    way = np.concatenate(pieces)
    return way[:, 0], way[:, 1], way[:, 2]
