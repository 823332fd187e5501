"""Trajectories of characters: what brush and arm can do, the phases of a stroke, and leading a dragged brush.

Convention: a point is x, y, H, alpha, heading. x and y are where the tip would meet the paper, in mm from the lower
left corner of the patch, y upward. H is the depth below the touch height. The ferrule leans by alpha toward `heading`,
counter-clockwise from x. The brush is pulled: heading is the direction of the stroke, so the ferrule leads and the
tip trails; the mark's widest place then lies at the brush axis, H tan(alpha) ahead of the point.

A dragged brush is led so that its ink rather than its tip follows the character. The points of all strokes are adjusted
together until the ink that `model.drag` predicts matches the wanted image: least squares over the pixels, by
Levenberg-Marquardt, through an edge that is first soft and then sharp. Every trial is made feasible by `Reach.within`
before it is judged.

A stroke has phases. It begins and ends with an exposed tip where its outline comes to a point, and with a hidden tip
where it ends broadly. It turns where its median bends by at least `TURN_DEG` over one width of the stroke, and such a
turn is a folding, as in a hook, where the bend grows to `FOLD_DEG` over three widths. The terms are those of the
literature on robotic calligraphy, such as "Brush Stroke-Based Writing Trajectory Control Model for Robotic Chinese
Calligraphy", Electronics 14 (15) 3000, 2025; the rules here are our own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from brushloop.model.damped import Equations, descend
from brushloop.model.drag import DISCS, Drawings, Footprint, Trails, ink, inked, marks, sampled, sampling

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
"""Ink of a patch from 0 to 1, (size, size), row 0 at its far (upper) edge."""
SIDE_UNITS, FOOT_UNITS = 1024.0, -124.0
"""Side of a font's square, and its lower edge, in font units."""
TURN_DEG, FOLD_DEG = 35.0, 90.0
"""Least bend of the median of a turning and of a folding."""
POINTED = 0.5
"""An end narrower than this share of the stroke's median width is an exposed tip."""
MARGIN_MM = 6.0
"""Margin around the font's square."""
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
    """The square patch that a character is written on, at least 30 mm wide."""

    side_mm: float = 70.0

    @property
    def mm_per_unit(self) -> float:
        """Size of a font unit in mm."""
        return (self.side_mm - 2 * MARGIN_MM) / SIDE_UNITS

    def to_mm(self, units: Floats) -> Floats:
        """Font units (..., 2) to mm from the patch's lower left corner, y upward."""
        return MARGIN_MM + self.mm_per_unit * (units - np.array([0.0, FOOT_UNITS]))


@dataclass(frozen=True, slots=True)
class StrokePath:
    """A path on the patch with a half width along it: `points` (N, 2) mm, `half_width_mm` (N,)."""

    points: Floats
    half_width_mm: Floats


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
    """x, y, depth and heading (N, 4) of a trajectory (N, 5): a path as the footprint of `model.drag` follows it."""
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
            rounds=ROUNDS,
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
        self._wanted = Drawings(strokes, one_image, wanted[None], *grid(side_mm, len(wanted)))
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
        at = self._marks([sampled(without_tilt(stroke)) for stroke in self.strokes(vector)])
        distance_mm = at.distances(self._wanted.x_mm, self._wanted.y_mm) + self._added_mm
        off = ink(distance_mm, spread_mm) - self._wanted.ink
        return 0.5 * float(np.sum(off**2)) + self._penalty(vector)

    def equations(self, vector: Floats, spread_mm: float) -> Equations:
        paths = [without_tilt(stroke) for stroke in self.strokes(vector)]
        at = self._marks([sampled(path) for path in paths])
        slopes = np.zeros((len(at.discs), 3, len(vector)))
        first = 0
        for number, path in enumerate(paths):
            nodes, (shares, down) = sampled(path), sampling(path)
            rows = slice(DISCS * first, DISCS * (first + len(nodes)))
            first += len(nodes)
            for point in range(len(path)):
                for column in range(4 if point == 0 else 3):
                    moved = nodes.copy()
                    moved[:, column] += 1e-3 * UNITS[column] * shares[:, point] * (down if column == 2 else 1.0)
                    changed = marks([moved], self._values[number]).discs
                    slopes[rows, :, 4 * (self._ends[number] + point) + column] = (changed - at.discs[rows]) / 1e-3
        found = at.equations(slopes, self._wanted, spread_mm, self._added_mm)
        gradient = found.gradient + self._bent @ vector + self._held * (vector - self._from)
        square = found.square + self._bent + self._held * np.eye(len(vector))
        return Equations(found.cost + self._penalty(vector), square, gradient)

    def _marks(self, nodes: list[Floats]) -> Trails:
        """The footprints of all strokes, as one image."""
        at = marks(nodes, self._values)
        return replace(at, groups=at.groups[[0, -1]])

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
