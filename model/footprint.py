"""A dragged brush as a footprint that has a length: three discs along a stick, pulled by the tip on a leash.

`model.drag` draws with a single disc, which is enough for long strokes. A character consists of ends and corners, and
there the length of the footprint shows: it lands behind the tip, swings round behind a corner, and is drawn towards the
tip when the brush lifts. Here the footprint is the hull of neighbouring discs, from the heel to the tips of the hairs.
Its middle rests until the leash is taut and then follows straight towards the tip (a tractrix); the stick turns towards
where it is pulled, over a length of its own, and is shorter while it is pulled across. A brush that is pressed deeper
slides away from the ferrule, by as much as if it had landed that deep. Every stroke begins and ends with a vertical
motion at depth 0, which marks as well. Leash, landing, places of the discs and half widths are quadratic in the depth.
The mark is the union of the footprints along the path. Lengths are mm, x and y in the frame of the path, y upward,
depth into the paper.

The simulated brush of the loopback rig is a stick on a taut leash as well (`drivers.sim.brush.drag`), though its
footprint is computed from bristles. What this model scores there is therefore no evidence for a real brush.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brushloop.model.drag import Drawings, Floats, Indices, distances, fit_to_ink

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
class Marks:
    """Footprints of several strokes: rows x, y, half width of the discs, and the row at which each footprint begins."""

    discs: Floats
    starts: Indices
    strokes: Indices
    """(strokes + 1,): footprints `strokes[i]` to `strokes[i + 1]` belong to stroke i."""


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

    def distance(self, paths: Sequence[Floats], x_mm: Floats, y_mm: Floats) -> Floats:
        """Signed distance in mm to the edge of the ink of all paths, positive in ink, (len(y_mm), len(x_mm)).

        A path is (N, 4): x, y, depth, heading in deg.
        """
        return inked([self] * len(paths), paths, x_mm, y_mm)


def inked(footprints: Sequence[Footprint], paths: Sequence[Floats], x_mm: Floats, y_mm: Floats) -> Floats:
    """The same as `Footprint.distance`, with a footprint for each path."""
    at = marks([sampled(path) for path in paths], np.array([footprint.values for footprint in footprints]))
    return distances(at.discs, at.starts, x_mm, y_mm, np.array([0, len(at.starts) - 1]))[0]


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


def marks(paths: Sequence[Floats], values: Floats) -> Marks:
    """The footprints along sampled paths, each (M, 4) of x, y, depth, heading in deg.

    `values` are those of one footprint, (28,), or of one for each path, (paths, 28).
    """
    from brushloop.model import drag_kernel  # numba takes a fifth of a second to import

    kernel: Any = drag_kernel
    ends = np.cumsum([0, *(len(path) for path in paths)])
    discs = np.empty((int(ends[-1]) * DISCS, 3))
    each = np.ascontiguousarray(np.broadcast_to(values, (len(paths), len(NAMES))))
    kernel.pull(np.ascontiguousarray(np.concatenate(paths)), ends, each, discs)
    return Marks(discs, DISCS * np.arange(int(ends[-1]) + 1), ends)


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

    def trails_at(vector: Floats) -> tuple[Floats, Indices, Indices]:
        at = marks(nodes, values(vector)[of])
        return at.discs, at.starts, at.strokes[drawings.groups]

    for spread_mm in spreads_mm:
        scaled = fit_to_ink(trails_at, scaled, drawings, spread_mm).vector
    return [Footprint(tuple(each)) for each in values(scaled).tolist()]
