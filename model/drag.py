"""Dragged strokes with bristle lag: the footprint trails behind the tip, so the ink is not where the command is.

A stamp moved along the commanded path cuts no corners and starts at full width; real ink cuts corners and starts
narrower (a path-tangent stamp of any shape scores like plain circles). Here the footprint is a disc whose centre p
follows the tip q over the length s of the path as a first-order lag,

    dp/ds = (q - p) / leash,    leash = leash_mm + leash_per_mm * depth,

and whose half width follows the depth with a separate lag, `settle_mm`. Drift describes how the brush is mounted: it
turns with the brush if the path gives a heading. The mark is the union of the discs between neighbouring nodes.
`model.footprint` draws with a footprint that has a length, for characters; both are fitted by `fit_to_ink`.
Lengths are mm, x and y in the frame of the path, y upward, depth into the paper. No torch here: numpy and, at the first
call, numba.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.model.damped import Damping, Equations, Lowest, descend

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
STEP = 1e-4
"""Change of a scaled value for its derivative."""
ROUNDS = 30
GAIN = 1e-4
"""Smallest share by which a step of a fit must lower the cost for another one to be made."""
DAMPING = Damping(first=1e-2, shrink=5.0, grow=6.0, least=1e-6)


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
    """Offset of the footprint from its lagged position, along the heading; along the x axis if a path has none."""
    drift_y_mm: float = 0.0
    drift_x_per_mm: float = 0.0
    """Growth of the drift per mm of depth."""
    drift_y_per_mm: float = 0.0
    land_mm: float = 0.0
    """Distance ahead of the tip, along the path's first direction, at which the footprint lands."""
    back_mm: float = 0.0
    """How far the mark extends behind the landing point."""
    front: float = 0.3
    """Share of the final gap between footprint and tip that is inked while the brush lifts off."""
    front_width: float = 0.5
    """Half width at that end, as a share of the last footprint's."""

    def vector(self) -> Floats:
        """The parameters in order, (14,)."""
        return np.array(astuple(self), np.float64)

    @staticmethod
    def names() -> tuple[str, ...]:
        """The parameters' names, in the order of `vector`."""
        return tuple(field.name for field in fields(DragModel))

    @staticmethod
    def of(vector: Floats) -> DragModel:
        """The model of a (14,) vector."""
        return DragModel(*(float(value) for value in vector))


@dataclass(frozen=True, slots=True)
class Drawings:
    """Images of ink on one grid of pixel centres, mm, y upward, and the strokes that were commanded for each."""

    paths: Sequence[Floats]
    """The strokes of all images in order, (n, 3) each: x, y, depth in mm; or (n, 4) with the heading in deg."""
    groups: Indices
    """(B + 1,): paths `groups[i]` to `groups[i + 1]` are the strokes of image i."""
    ink: NDArray[np.float32]
    """(B, len(y_mm), len(x_mm)) from 0 to 1."""
    x_mm: Floats
    y_mm: Floats
    weights: Floats
    """(B,) how often each image counts in a fit."""

    def __post_init__(self) -> None:
        shape = (len(self.weights), len(self.y_mm), len(self.x_mm))
        if self.ink.shape != shape or len(self.groups) != shape[0] + 1 or self.groups[-1] != len(self.paths):
            raise ValueError(
                f"{len(self.groups) - 1} images of {len(self.paths)} strokes, ink {self.ink.shape}: not alike"
            )

    def only(self, images: Indices) -> Drawings:
        """These images and their strokes."""
        each = [self.paths[int(self.groups[i]) : int(self.groups[i + 1])] for i in images]
        groups = np.cumsum([0, *(len(strokes) for strokes in each)])
        paths = [path for strokes in each for path in strokes]
        return replace(self, paths=paths, groups=groups, ink=self.ink[images], weights=self.weights[images])

    def weighted(self, share: float) -> Drawings:
        """The same with every weight multiplied."""
        return replace(self, weights=share * self.weights)

    def every(self, step: int) -> Drawings:
        """The same with only each `step`-th row and column."""
        return replace(self, ink=self.ink[:, ::step, ::step], x_mm=self.x_mm[::step], y_mm=self.y_mm[::step])


def ink(distance_mm: Floats, spread_mm: float) -> Floats:
    """Probability of ink at a signed distance, if the edge varies by `spread_mm` (logistic)."""
    return 1.0 / (1.0 + np.exp(-np.clip(distance_mm / spread_mm, -40.0, 40.0)))


def trails(paths: Sequence[Floats], vector: Floats) -> tuple[Floats, Indices]:
    """All paths' trails concatenated, (sum(n + 2), 3), and the rows where each begins and the last ends, (B + 1,).

    A path is (n, 3) nodes x, y, depth of the tip, or (n, 4) with the heading in degrees, counter-clockwise from x. Its
    trail, that of the footprint, is (n + 2, 3) x, y, half width, mm; the first and the last row are the mark's ends
    behind the landing and ahead of the lift-off. Raises ValueError for another shape, or fewer than 2 nodes.
    """
    for path in paths:
        if path.ndim != 2 or path.shape[1] not in (3, 4) or len(path) < 2:
            raise ValueError(f"a path is (n, 3) or (n, 4) with n >= 2, got {path.shape}")
    from brushloop.model.drag_kernel import follow  # numba takes a fifth of a second to import

    ends = np.cumsum([0, *(len(path) for path in paths)])
    starts = ends + 2 * np.arange(len(ends))
    out, nodes = np.empty((int(starts[-1]), 3)), np.zeros((int(ends[-1]), 4))
    for path, end in zip(paths, ends[1:], strict=True):
        nodes[end - len(path) : end, : path.shape[1]] = path
    nodes[:, 3] = np.radians(nodes[:, 3])
    follow(nodes, ends, np.asarray(vector, np.float64), out, starts)
    return out, starts


def distances(nodes: Floats, starts: Indices, x_mm: Floats, y_mm: Floats, groups: Indices | None = None) -> Floats:
    """Signed distance of every trail on one grid, (B, len(y_mm), len(x_mm)) mm, positive in ink.

    For images of several strokes, image i shows trails `groups[i]` to `groups[i + 1]`, (B + 1,).
    """
    from brushloop.model.drag_kernel import signed

    each = np.arange(len(starts)) if groups is None else groups
    out = np.empty((len(each) - 1, len(y_mm), len(x_mm)))
    signed(nodes, starts, each, np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64), out)
    return out


def ink_equations(
    nodes: Floats,
    starts: Indices,
    groups: Indices,
    slopes: Floats,
    drawings: Drawings,
    spread_mm: float,
    added_mm: Floats | None = None,
) -> Equations:
    """Normal equations of the modelled less the given ink.

    Trails `groups[i]` to `groups[i + 1]` make image i, and `slopes` (rows, 3, P) are the derivatives of their nodes.
    `added_mm` (B, len(y_mm), len(x_mm)) is added to the signed distances: what the model is known to miss.
    """
    from brushloop.model import drag_kernel

    kernel: Any = drag_kernel
    count = slopes.shape[2]
    square, gradient = np.zeros((count, count)), np.zeros(count)
    added = np.zeros((1, *drawings.ink.shape[1:])) if added_mm is None else np.ascontiguousarray(added_mm, np.float64)
    ink, weights = np.ascontiguousarray(drawings.ink, np.float32), np.ascontiguousarray(drawings.weights, np.float64)
    x_mm, y_mm = np.ascontiguousarray(drawings.x_mm), np.ascontiguousarray(drawings.y_mm)
    cost = kernel.normal_equations(
        nodes, starts, groups, slopes, x_mm, y_mm, ink, added, weights, spread_mm, square, gradient
    )
    return Equations(float(cost), np.tril(square) + np.tril(square, -1).T, gradient)


def derivatives(nodes_at: Callable[[Floats], Floats], scaled: Floats) -> Floats:
    """The derivatives (rows, 3, P) of nodes by scaled values (P,)."""
    nodes = nodes_at(scaled)
    each = [(nodes_at(scaled + STEP * unit) - nodes) / STEP for unit in np.eye(len(scaled))]
    return np.stack(each, axis=-1)


def fit_to_ink(
    trails_at: Callable[[Floats], tuple[Floats, Indices, Indices]],
    start: Floats,
    drawings: Drawings,
    spread_mm: float,
    added_mm: Floats | None = None,
) -> Lowest:
    """Fit scaled values (P,) to drawings by least squares, each with a prior of unit variance around 0.

    `trails_at` gives nodes, the rows where trails begin, and the trails where images begin, as in `ink_equations`.
    """

    def equations(scaled: Floats) -> Equations:
        nodes, starts, groups = trails_at(scaled)
        slopes = derivatives(lambda values: trails_at(values)[0], scaled)
        at = ink_equations(nodes, starts, groups, slopes, drawings, spread_mm, added_mm)
        cost = at.cost + 0.5 * float(scaled @ scaled)
        return Equations(cost, at.square + np.eye(len(scaled)), at.gradient + scaled)

    return descend(equations, start, rounds=ROUNDS, most=2.0, gain=GAIN, damping=DAMPING)
