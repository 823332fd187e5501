"""A brush dragged along the paper: where its footprint goes, its ink, and its fit to ink.

A stamp moved along the commanded path cuts no corners and starts at full width; real ink cuts corners and starts
narrower (a path-tangent stamp of any shape scores like plain circles). A drag is drawn by a disc whose centre p follows
the tip q over the length s of the path as a first-order lag,

    dp/ds = (q - p) / leash,    leash = leash_mm + leash_per_mm * depth,

and whose half width follows the depth with a separate lag, `settle_mm`. Drift describes how the brush is mounted. The
mark is the union of the discs between neighbouring nodes.

A character consists of ends and corners, where the footprint's length shows: it lands behind the tip, swings round
behind a corner, and is drawn towards the tip when the brush lifts. There the footprint is the hull of neighbouring
discs along a stick, from the heel to the tips of the hairs. Its middle rests until the leash is taut and then follows
straight towards the tip (a tractrix); the stick turns towards where it is pulled, over a length of its own, and is
shorter while it is pulled across. A brush that is pressed deeper slides away from the ferrule, by as much as if it had
landed that deep. Every stroke begins and ends with a vertical motion at depth 0, which marks as well. Leash, landing,
places of the discs and half widths are quadratic in the depth. The simulated brush of the loopback rig is a stick on a
taut leash as well, though its footprint is computed from bristles: what this scores there is no evidence for a real
brush.

Lengths are mm, x and y in the frame of the path, y upward, depth into the paper. numpy and, at the first call, numba.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.model.damped import Damping, Equations, descend

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
STEP = 1e-4
"""Change of a scaled value for its derivative."""
ROUNDS = 30
GAIN = 1e-4
"""Smallest share by which a step of a fit must lower the cost for another one to be made."""
DAMPING = Damping(first=1e-2, shrink=5.0, grow=6.0, least=1e-6)
DISCS = 3
STEP_MM = 0.5
"""Longest distance of the tip between two footprints of a mark."""
OF_STICK = (
    *("leash_mm", "leash_per_mm", "leash_per_mm2", "land_mm", "land_per_mm", "land_per_mm2"),
    *("turn_mm", "turn_per_mm", "across_mm", "thinner_per_mm"),
)
"""Leash, distance behind the tip at which the middle lands, length over which the stick turns: each at depth 0, then
its growth. Offset to the left of the stick, and half width lost per mm of path."""
PER_DISC = ("ahead_mm", "ahead_per_mm", "ahead_per_mm2", "half_mm", "half_per_mm", "half_per_mm2")
"""Place along the stick, ahead of the middle, and half width: each at depth 0, then its growth."""
NAMES = (*OF_STICK, *(f"{name}_{disc}" for disc in range(1, DISCS + 1) for name in PER_DISC))
START = (
    *(0.5, 0.5, 0.0, 0.5, 0.5, 0.0),
    *(0.2, 0.3, 0.0, 0.0),
    *(0.3, 0.4, 0.0, 0.2, 0.15, 0.0),
    *(0.0, 0.0, 0.0, 0.2, 0.25, 0.0),
    *(-0.3, -0.4, 0.0, 0.2, 0.15, 0.0),
)
"""A starting point for a fit, not a real brush."""
SCALE = (
    *(1.5, 0.4, 0.02, 1.5, 0.4, 0.02),
    *(1.0, 0.2, 1.0, 0.01),
    *(1.0, 0.4, 0.02, 0.5, 0.15, 0.01) * DISCS,
)
"""How far each parameter may be from its start before it costs as much as one pixel of wrong ink."""
EACH_SCALE = 0.5
"""The same for footprints of single strokes, as a share."""
SPREADS_MM = (0.8, 0.3)
"""Softness of the edge in a fit: first wide, so that ink that is far off still pulls, then narrow."""


@dataclass(frozen=True, slots=True)
class DragModel:
    """One brush dragged along the paper. The defaults are a starting point for a fit, not a real brush."""

    half_mm: float = 3.0
    """Half width at depth 0, extrapolated; ink ends where the half width falls below 0."""
    half_per_mm: float = 0.25
    """Growth of the half width per mm of depth."""
    half_per_mm2: float = 0.0
    leash_mm: float = 2.0
    """Distance by which the footprint trails the tip at depth 0."""
    leash_per_mm: float = 0.35
    """Growth of the leash per mm of depth."""
    settle_mm: float = 3.0
    """Path length over which the footprint's width follows the depth."""
    drift_x_mm: float = 0.0
    """Offset of the footprint from its lagged position."""
    drift_y_mm: float = 0.0
    drift_x_per_mm: float = 0.0
    """Growth of the drift per mm of depth."""
    drift_y_per_mm: float = 0.0
    land_mm: float = 0.0
    """Distance ahead of the tip, along the path's first direction, at which the footprint lands."""
    front: float = 0.3
    """Share of the final gap between footprint and tip that is inked while the brush lifts off."""
    front_width: float = 0.5
    """Half width at that end, as a share of the last footprint's."""

    def vector(self) -> Floats:
        """The parameters in order, (13,)."""
        return np.array(astuple(self), np.float64)

    @staticmethod
    def names() -> tuple[str, ...]:
        """The parameters' names, in the order of `vector`."""
        return tuple(field.name for field in fields(DragModel))

    @staticmethod
    def of(vector: Floats) -> DragModel:
        """The model of a (13,) vector."""
        return DragModel(*(float(value) for value in vector))


@dataclass(frozen=True, slots=True)
class Drawings:
    """Images of ink on one grid of pixel centres, mm, y upward, and the strokes that were commanded for each."""

    paths: Sequence[Floats]
    """The strokes of all images in order: (n, 3) of x, y, depth in mm for the lag, (n, 4) with the heading in deg for
    the footprint."""
    groups: Indices
    """(B + 1,): paths `groups[i]` to `groups[i + 1]` are the strokes of image i."""
    ink: NDArray[np.float32]
    """(B, len(y_mm), len(x_mm)) from 0 to 1."""
    x_mm: Floats
    y_mm: Floats

    @staticmethod
    def of(strokes: Sequence[Sequence[Floats]], ink: NDArray[np.float32], x_mm: Floats, y_mm: Floats) -> Drawings:
        """Images (B, len(y_mm), len(x_mm)) of the strokes of each."""
        groups = np.cumsum([0, *(len(paths) for paths in strokes)])
        return Drawings([path for paths in strokes for path in paths], groups, ink, x_mm, y_mm)

    def only(self, images: Indices) -> Drawings:
        """These images and their strokes."""
        strokes = [self.paths[int(self.groups[i]) : int(self.groups[i + 1])] for i in images]
        return Drawings.of(strokes, self.ink[images], self.x_mm, self.y_mm)

    def every(self, step: int) -> Drawings:
        """The same with only each `step`-th row and column."""
        return replace(self, ink=self.ink[:, ::step, ::step], x_mm=self.x_mm[::step], y_mm=self.y_mm[::step])


def ink(distance_mm: Floats, spread_mm: float) -> Floats:
    """Probability of ink at a signed distance, if the edge varies by `spread_mm` (logistic)."""
    return 1.0 / (1.0 + np.exp(-np.clip(distance_mm / spread_mm, -40.0, 40.0)))


@dataclass(frozen=True, slots=True)
class Trails:
    """Chains of discs whose hulls are the ink, and which of them each image shows."""

    discs: Floats
    """(rows, 3) of x, y, half width in mm, all chains after each other."""
    starts: Indices
    """(trails + 1,): the row where each chain begins, and where the last one ends."""
    groups: Indices
    """(B + 1,): image i shows the trails `groups[i]` to `groups[i + 1]`."""

    def distances(self, x_mm: Floats, y_mm: Floats) -> Floats:
        """Signed distances in mm to the edge of the ink, positive in ink, (B, len(y_mm), len(x_mm))."""
        from brushloop.model.drag_kernel import signed

        out = np.empty((len(self.groups) - 1, len(y_mm), len(x_mm)))
        signed(self.discs, self.starts, self.groups, np.ascontiguousarray(x_mm), np.ascontiguousarray(y_mm), out)
        return out

    def equations(
        self, slopes: Floats, drawings: Drawings, spread_mm: float, added_mm: Floats | None = None
    ) -> Equations:
        """Normal equations of the modelled less the given ink; `slopes` (rows, 3, P) are the derivatives of the discs.

        `added_mm` (B, len(y_mm), len(x_mm)) is added to the signed distances: what the model is known to miss.
        """
        from brushloop.model import drag_kernel

        kernel: Any = drag_kernel
        count = slopes.shape[2]
        square, gradient = np.zeros((count, count)), np.zeros(count)
        added = np.zeros((1, *drawings.ink.shape[1:])) if added_mm is None else added_mm
        seen, x_mm, y_mm = (np.ascontiguousarray(part) for part in (drawings.ink, drawings.x_mm, drawings.y_mm))
        chains = self.discs, self.starts, self.groups
        cost = kernel.normal_equations(*chains, slopes, x_mm, y_mm, seen, added, spread_mm, square, gradient)
        return Equations(float(cost), np.tril(square) + np.tril(square, -1).T, gradient)


def lagging(paths: Sequence[Floats], vector: Floats) -> Trails:
    """The trails of a lagging disc, one for each path of (n, 3) nodes x, y, depth of the tip, n >= 2.

    A trail has n + 1 discs; the last one is the mark's end ahead of the lift-off.
    """
    from brushloop.model.drag_kernel import follow  # numba takes a fifth of a second to import

    ends = np.cumsum([0, *(len(path) for path in paths)])
    starts = ends + np.arange(len(ends))
    out = np.empty((int(starts[-1]), 3))
    follow(np.ascontiguousarray(np.concatenate(paths)), ends, vector, out, starts)
    return Trails(out, starts, np.arange(len(ends)))


def derivatives(trails_at: Callable[[Floats], Trails], scaled: Floats) -> Floats:
    """The derivatives (rows, 3, P) of discs by scaled values (P,)."""
    discs = trails_at(scaled).discs
    each = [(trails_at(scaled + STEP * unit).discs - discs) / STEP for unit in np.eye(len(scaled))]
    return np.stack(each, axis=-1)


def fit_to_ink(trails_at: Callable[[Floats], Trails], start: Floats, drawings: Drawings, spread_mm: float) -> Floats:
    """Fit scaled values (P,) to drawings by least squares, each with a prior of unit variance around 0."""

    def equations(scaled: Floats) -> Equations:
        at = trails_at(scaled).equations(derivatives(trails_at, scaled), drawings, spread_mm)
        cost = at.cost + 0.5 * float(scaled @ scaled)
        return Equations(cost, at.square + np.eye(len(scaled)), at.gradient + scaled)

    return descend(equations, start, rounds=ROUNDS, most=2.0, gain=GAIN, damping=DAMPING).vector


@dataclass(frozen=True, slots=True)
class Footprint:
    """One brush: the values of `NAMES`."""

    values: tuple[float, ...] = START

    def __post_init__(self) -> None:
        if len(self.values) != len(NAMES) or not all(map(math.isfinite, self.values)):
            raise ValueError(f"a footprint has {len(NAMES)} finite values, got {len(self.values)}")

    def half_width_mm(self, depth_mm: Floats) -> Floats:
        """Half width of a straight mark, (N,) -> (N,) mm."""
        discs = np.reshape(self.values[len(OF_STICK) :], (DISCS, len(PER_DISC)))
        return np.max([_quadratic(disc[3:], depth_mm) for disc in discs], axis=0)

    def lag_mm(self, depth_mm: Floats) -> Floats:
        """Distance of the footprint's middle behind the tip in a straight stroke, (N,) -> (N,) mm."""
        return np.maximum(_quadratic(np.array(self.values[:3]), depth_mm), 0.0)


def inked(footprints: Sequence[Footprint], paths: Sequence[Floats], x_mm: Floats, y_mm: Floats) -> Floats:
    """Signed distance in mm to the edge of the ink of all paths, positive in ink, (len(y_mm), len(x_mm)).

    A path is (N, 4): x, y, depth, heading in deg. Each is drawn by a footprint of its own.
    """
    at = marks([sampled(path) for path in paths], np.array([footprint.values for footprint in footprints]))
    return replace(at, groups=at.groups[[0, -1]]).distances(x_mm, y_mm)[0]


def _quadratic(of: Floats, depth_mm: Floats) -> Floats:
    return of[0] + of[1] * depth_mm + of[2] * depth_mm**2


def sampling(path: Floats) -> tuple[Floats, Floats]:
    """How nodes at most `STEP_MM` apart, corners included, follow from an (N, 4) path with its landing and its lift.

    Returns shares of the path's points, (M, N), and factors on the depth, (M,): from 0 to 1 while the brush lands on
    the first point, from 1 to 0 while it lifts from the last.
    """
    each = np.eye(len(path))
    corners = [each[0], *each, each[-1]]
    down = [0.0, *np.ones(len(path)), 0.0]
    steps_mm = [path[0, 2], *np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1), path[-1, 2]]
    shares, factors = [each[:1]], [np.zeros(1)]
    for k, step_mm in enumerate(steps_mm):
        at = np.linspace(0.0, 1.0, max(1, math.ceil(step_mm / STEP_MM)) + 1)[1:]
        shares.append(corners[k] + at[:, None] * (corners[k + 1] - corners[k]))
        factors.append(down[k] + at * (down[k + 1] - down[k]))
    return np.concatenate(shares), np.concatenate(factors)


def sampled(path: Floats) -> Floats:
    """(N, 4) path -> (M, 4) nodes from depth 0 back to depth 0, at most `STEP_MM` apart, corners included."""
    shares, down = sampling(path)
    nodes = shares @ path
    nodes[:, 2] *= down
    return nodes


def marks(paths: Sequence[Floats], values: Floats) -> Trails:
    """The footprints along sampled paths, each (M, 4) of x, y, depth, heading in deg; each path is an image.

    `values` are those of one footprint, (28,), or of one for each path, (paths, 28).
    """
    from brushloop.model import drag_kernel

    kernel: Any = drag_kernel
    ends = np.cumsum([0, *(len(path) for path in paths)])
    discs = np.empty((int(ends[-1]) * DISCS, 3))
    each = np.ascontiguousarray(np.broadcast_to(values, (len(paths), len(NAMES))))
    kernel.pull(np.ascontiguousarray(np.concatenate(paths)), ends, each, discs)
    return Trails(discs, DISCS * np.arange(int(ends[-1]) + 1), ends)


def fit_footprint(drawings: Drawings, start: Footprint | None = None) -> Footprint:
    """Fit the footprint to drawings. From a `start`, values change half as freely and only the narrow edge is used."""
    same = np.zeros(len(drawings.paths), np.int64)
    if start is None:
        return _fitted(drawings, START, same, 1.0, SPREADS_MM)[0]
    return _fitted(drawings, start.values, same, 0.5, SPREADS_MM[-1:])[0]


def fit_each(drawings: Drawings, start: Footprint) -> list[Footprint]:
    """Fit a footprint to each stroke, all near `start`."""
    own = np.arange(len(drawings.paths))
    return _fitted(drawings, start.values, own, EACH_SCALE, SPREADS_MM[-1:])


def _fitted(
    drawings: Drawings, start: tuple[float, ...], of: Indices, share: float, spreads_mm: Sequence[float]
) -> list[Footprint]:
    """The footprints 0 to max(of), where number `of[i]` follows path i; values change by `share` of `SCALE`."""
    nodes = [sampled(path) for path in drawings.paths]
    first, scale = np.array(start), share * np.array(SCALE)
    scaled = np.zeros((int(of.max()) + 1) * len(NAMES))

    def values(vector: Floats) -> Floats:
        return first + scale * vector.reshape(-1, len(NAMES))

    def trails_at(vector: Floats) -> Trails:
        at = marks(nodes, values(vector)[of])
        return replace(at, groups=at.groups[drawings.groups])

    for spread_mm in spreads_mm:
        scaled = fit_to_ink(trails_at, scaled, drawings, spread_mm)
    return [Footprint(tuple(each)) for each in values(scaled).tolist()]
