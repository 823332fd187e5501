"""Plans that lead a dragged brush, so that its ink rather than its tip follows the character.

The points of all strokes are adjusted together until the ink that `model.drag` predicts matches the wanted image:
least squares over the pixels, by Levenberg-Marquardt, through an edge that is first soft and then sharp. Every trial is
made feasible by `Reach.within` before it is judged.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brushloop.model.characters.plan import Floats, Image, Reach, StrokePath, directions, grid, tangents, without_tilt
from brushloop.model.damped import Equations, descend
from brushloop.model.drag import Drawings, Footprint, distances, ink, ink_equations, inked, marks, sampled, sampling

UNITS = np.array([0.3, 0.3, 0.5, 10.0])
"""Steps of x, y, depth (mm) and heading (deg) that count as equally large."""
BENT = 0.015
"""Cost of a squared second difference along a stroke, in these units: keeps the path calm where ink tells nothing."""
FIRST_SPREADS_MM, LATER_SPREADS_MM = (1.5, 0.8, 0.4, 0.2), (0.8, 0.4, 0.2)
ROUNDS = 60
PLUNGE = 3.0
"""Greatest change of depth per mm of a led path: more than that of `Reach`, since the footprint knows how the brush
lands straight down and lifts straight up. Corners and ends need it."""
GAIN = 5e-4
"""Smallest share by which a step must lower the cost for another one to be made."""


def first_lead(
    paths: Sequence[StrokePath], footprint: Footprint, reach: Reach, side_mm: float, tilt_deg: float
) -> list[Floats]:
    """Trajectories (N, 5) with the depth of each width, whose tip is one lag ahead along the stroke."""
    reach = replace(reach, plunge=PLUNGE)
    depths = np.linspace(*reach.depth_mm, 64)
    halves = np.maximum.accumulate(footprint.half_width_mm(depths))
    out: list[Floats] = []
    for path in paths:
        depth = np.interp(path.half_width_mm, halves, depths)
        heading = tangents(path.points)
        tip = path.points + footprint.lag_mm(depth)[:, None] * directions(heading)
        out.append(reach.within(np.column_stack((tip, depth, np.full(len(depth), tilt_deg), heading)), side_mm))
    return out


def lead(
    footprints: Sequence[Footprint],
    strokes: Sequence[Floats],
    wanted: Image,
    side_mm: float,
    reach: Reach,
    *,
    added_mm: Floats | None = None,
    held: float = 0.0,
    spreads_mm: Sequence[float] = FIRST_SPREADS_MM,
    rounds: int = ROUNDS,
) -> list[Floats]:
    """Adjust trajectories (N, 5) until their predicted ink is `wanted` (S, S), row 0 at the patch's far edge.

    Each stroke has a footprint of its own. x, y and depth of every point change, and the heading in which a stroke
    lands. `added_mm` (S, S) is added to the predicted signed distances: what the footprints are known to miss. `held`
    is the cost of the squared change of each variable, in `UNITS`: what was measured along one path holds only near
    it. Points stay `Reach.apart_mm` apart.
    """
    problem = _Problem(footprints, strokes, wanted, side_mm, replace(reach, plunge=PLUNGE), added_mm, held)
    vector = problem.vector(strokes)
    for spread_mm in spreads_mm:
        vector = descend(
            lambda v, s=spread_mm: problem.equations(v, s),
            vector,
            rounds=rounds,
            most=3.0,
            gain=GAIN,
            cost=lambda v, s=spread_mm: problem.cost(v, s),
            feasible=lambda v: problem.vector(problem.strokes(v)),
        ).vector
    return [reach.spaced(np.round(stroke, 3)) for stroke in problem.strokes(vector)]


def drawn(footprints: Sequence[Footprint], strokes: Sequence[Floats], side_mm: float, size_px: int) -> Floats:
    """Signed distance in mm to the edge of the predicted ink, (size, size), positive in ink, row 0 at the far edge.

    Each stroke (N, 5) has a footprint of its own.
    """
    return inked(footprints, [without_tilt(stroke) for stroke in strokes], *grid(side_mm, size_px))


def covered(distance_mm: Floats, side_mm: float) -> Image:
    """Ink from 0 to 1 of (size, size) signed distances: rises over one pixel."""
    return np.clip(0.5 + distance_mm * len(distance_mm) / side_mm, 0.0, 1.0).astype(np.float32)


class _Problem:
    """The least squares of one character. Its vector holds x, y, depth, heading of every point, in `UNITS`."""

    def __init__(
        self,
        footprints: Sequence[Footprint],
        strokes: Sequence[Floats],
        wanted: Image,
        side_mm: float,
        reach: Reach,
        added_mm: Floats | None,
        held: float,
    ) -> None:
        self._values = np.array([footprint.values for footprint in footprints])
        self._like = [stroke.copy() for stroke in strokes]
        self._ends = np.cumsum([0, *(len(stroke) for stroke in strokes)])
        self._side_mm, self._reach = side_mm, reach
        self._added_mm = np.zeros((1, *wanted.shape)) if added_mm is None else added_mm[None]
        one_image = np.array([0, len(strokes)])
        self._wanted = Drawings(strokes, one_image, wanted[None], *grid(side_mm, len(wanted)), np.ones(1))
        self._bent = _bending(self._ends)
        self._from, self._held = self.vector(strokes), held

    def vector(self, strokes: Sequence[Floats]) -> Floats:
        return (np.concatenate([without_tilt(stroke) for stroke in strokes]) / UNITS).ravel()

    def strokes(self, vector: Floats) -> list[Floats]:
        points = vector.reshape(-1, 4) * UNITS
        out: list[Floats] = []
        for like, first, last in zip(self._like, self._ends, self._ends[1:], strict=False):
            stroke = like.copy()
            stroke[:, :3], stroke[0, 4] = points[first:last, :3], points[first, 3]
            out.append(self._reach.within(stroke, self._side_mm))
        return out

    def cost(self, vector: Floats, spread_mm: float) -> float:
        at = marks([sampled(without_tilt(stroke)) for stroke in self.strokes(vector)], self._values)
        each = np.array([0, len(at.starts) - 1])
        distance_mm = distances(at.discs, at.starts, self._wanted.x_mm, self._wanted.y_mm, each) + self._added_mm
        off = ink(distance_mm, spread_mm) - self._wanted.ink
        return 0.5 * float(np.sum(off**2)) + self._penalty(vector)

    def equations(self, vector: Floats, spread_mm: float) -> Equations:
        paths = [without_tilt(stroke) for stroke in self.strokes(vector)]
        at = marks([sampled(path) for path in paths], self._values)
        slopes = np.zeros((len(at.discs), 3, len(vector)))
        for number, path in enumerate(paths):
            nodes, (shares, down) = sampled(path), sampling(path)
            rows = slice(*at.starts[at.strokes[number : number + 2]])
            for point in range(len(path)):
                for column in range(4 if point == 0 else 3):
                    moved = nodes.copy()
                    moved[:, column] += 1e-3 * UNITS[column] * shares[:, point] * (down if column == 2 else 1.0)
                    changed = marks([moved], self._values[number]).discs
                    slopes[rows, :, 4 * (self._ends[number] + point) + column] = (changed - at.discs[rows]) / 1e-3
        each = np.array([0, len(at.starts) - 1])
        found = ink_equations(at.discs, at.starts, each, slopes, self._wanted, spread_mm, self._added_mm)
        gradient = found.gradient + self._bent @ vector + self._held * (vector - self._from)
        square = found.square + self._bent + self._held * np.eye(len(vector))
        return Equations(found.cost + self._penalty(vector), square, gradient)

    def _penalty(self, vector: Floats) -> float:
        moved = vector - self._from
        return 0.5 * float(vector @ self._bent @ vector) + 0.5 * self._held * float(moved @ moved)


def _bending(ends: NDArray[np.int64]) -> Floats:
    """The quadratic form of the squared second differences of x, y and depth along each stroke."""
    size = 4 * int(ends[-1])
    out = np.zeros((size, size))
    second = np.array([1.0, -2.0, 1.0])
    for first, last in itertools.pairwise(ends):
        for point in range(first + 1, last - 1):
            for column in range(3):
                at = 4 * np.array([point - 1, point, point + 1]) + column
                out[np.ix_(at, at)] += BENT * UNITS[column] ** 2 * np.outer(second, second)
    return out
