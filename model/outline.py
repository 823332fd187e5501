"""The outline of a mark: a closed loop of conic arcs.

A conic arc is a quadratic Bezier curve with a weight w on its middle point (L. Piegl and W. Tiller, "The NURBS
Book", 2nd ed., ch. 7): w = 1 is a parabola or, with the middle point halfway, a straight line; 0 < w < 1 is an arc
of an ellipse that spans 2 acos(w) of it. So lines, circles, ellipses and CCD-BSM's parabolas are exact; other
curves are cut into short parabolas by `through`.

The frame is defined in `model.raster`. All parameters are batched: one mark per row, `(B,)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = Any
"""An array of numpy; where a parameter is meant, a number as well."""


def as_batch(*values: Array) -> tuple[Array, ...]:
    """All values as float64 arrays (B,), broadcast to each other. Raises ValueError for more than one dimension."""
    batch = [np.atleast_1d(np.asarray(value, np.float64)) for value in values]
    if any(part.ndim > 1 for part in batch):
        raise ValueError(f"stroke parameters: scalars or shape (B,), got shapes {[part.shape for part in batch]}")
    return tuple(np.broadcast_arrays(*batch))


def safe_sqrt(value: Array) -> Array:
    """The square root of max(value, 0): rounding may take what is 0 below it."""
    return np.sqrt(np.maximum(value, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """B closed loops of K conic arcs, mm: `points` (B, K, 3, 2) and `weights` (B, K), 0 < w <= 1.

    Each arc ends where the next begins, and a loop runs counter-clockwise with x to the right and y up. Where a
    loop that crosses itself winds twice around an area, the area is drawn once.
    """

    points: Array
    weights: Array

    @property
    def x_min_mm(self) -> Array:
        """The least x, the end on the tip side, (B,)."""
        return self._extreme(0, -1)

    @property
    def x_max_mm(self) -> Array:
        """The greatest x, the end on the heel side, (B,)."""
        return self._extreme(0, 1)

    @property
    def width_mm(self) -> Array:
        """The extent along y, (B,)."""
        return self._extreme(1, 1) - self._extreme(1, -1)

    @property
    def area_mm2(self) -> Array:
        """The enclosed area by Green's theorem, (B,): the polygon of the arcs' ends plus a segment under each."""
        start, middle, end = _nodes(self.points)
        polygon = 0.5 * cross(start, end)
        # A parabola fills two thirds of its triangle (Archimedes).
        parabola = cross(middle - start, end - start) / 3
        curved = self.weights < 1
        w = np.where(curved, self.weights, 0.5)
        _, along, across = ellipse_of(self.points, w)
        sine = safe_sqrt((1 - w) * (1 + w))
        segment = cross(along, across) * (np.arctan2(sine, w) - sine * w)
        return (polygon + np.where(curved, segment, parabola)).sum(-1)

    def polyline(self, per_arc: int = 32) -> Array:
        """Points on the loop in order, per_arc on each arc, (B, K per_arc, 2) mm; the last joins the first."""
        if per_arc < 1:
            raise ValueError(f"per_arc = {per_arc}: expected at least one point per arc")
        t = np.arange(per_arc) / per_arc
        points = evaluate(self.points[:, :, None], self.weights[:, :, None], t)
        return points.reshape(len(points), -1, 2)

    def _extreme(self, axis: int, sign: int) -> Array:
        """The greatest of sign * coordinate over each loop, times sign, (B,)."""
        p0, p1, p2 = (sign * node[..., axis] for node in _nodes(self.points))
        ends = np.maximum(p0, p2)
        # An arc leaves the span of its ends only if its middle point does.
        curved = self.weights < 1
        w = np.where(curved, self.weights, 0.5)
        centre, along, across = (sign * part[..., axis] for part in ellipse_of(self.points, w))
        ellipse = centre + safe_sqrt(along**2 + across**2)
        bend = p0 - 2 * p1 + p2
        parabola = p0 - (p0 - p1) ** 2 / np.where(bend == 0, 1.0, bend)
        beyond = np.where(curved, ellipse, parabola)
        return sign * np.max(np.where(p1 > ends, beyond, ends), -1)


def cross(a: Array, b: Array) -> Array:
    """The z part of the cross product of plane vectors, (..., 2), (..., 2) -> (...)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def ellipse_of(points: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Centre C and half axes E, F of arcs of ellipses, (..., 3, 2), (...) -> three (..., 2).

    The arc is C + E cos u + F sin u for |u| <= acos(w); E points to the middle of the arc. Requires 0 < w < 1.
    """
    start, middle, end = _nodes(points)
    w = weights[..., None]
    chord = 0.5 * (start + end)
    centre = middle + (chord - middle) / ((1 - w) * (1 + w))
    return centre, (chord - centre) / w, 0.5 * (end - start) / safe_sqrt((1 - w) * (1 + w))


def evaluate(points: Array, weights: Array, t: Array) -> Array:
    """Conic arcs at t, broadcast: (..., 3, 2), (...), (...) -> (..., 2)."""
    start, middle, end = _nodes(points)
    b0, b1, b2 = (b[..., None] for b in ((1 - t) ** 2, 2 * weights * t * (1 - t), t**2))
    return (b0 * start + b1 * middle + b2 * end) / (b0 + b1 + b2)


def through(curve: Array) -> Array:
    """Parabolas through a finely sampled curve, (B, 2 N + 1, 2) -> (B, N, 3, 2): each takes three points.

    The error falls with the third power of the step; its sign changes within a piece, so areas keep the fourth.
    """
    start, on, end = curve[:, :-1:2], curve[:, 1::2], curve[:, 2::2]
    return np.stack((start, 2 * on - 0.5 * (start + end), end), 2)


def closed(*curves: Array) -> Outline:
    """The outline of parabolas through finely sampled curves (B, 2 N + 1, 2), joined by straight lines in order."""
    arcs: list[Array] = []
    for curve, following in zip(curves, (*curves[1:], curves[0]), strict=True):
        end, start = curve[:, -1], following[:, 0]
        arcs += [through(curve), np.stack((end, 0.5 * (end + start), start), 1)[:, None]]
    points = np.concatenate(arcs, 1)
    return Outline(points, np.ones_like(points[..., 0, 0]))


def rounded(centre: Array, half_x: Array, half_y: Array, corner_x: Array, corner_y: Array) -> Outline:
    """A box around (centre, 0) with quarter-ellipse corners, all (B,) mm: four corners, each with the side after it.

    Corners as large as the box make an ellipse, whose sides have no length.
    """
    flat_x, flat_y = half_x - corner_x, half_y - corner_y
    corners: list[Array] = []
    for k, (right, up) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        side = np.stack((centre + right * half_x, up * flat_y), -1)
        top = np.stack((centre + right * flat_x, up * half_y), -1)
        corner = np.stack((centre + right * half_x, up * half_y), -1)
        corners.append(np.stack((side, corner, top) if k % 2 == 0 else (top, corner, side), 1))
    arcs: list[Array] = []
    for this, following in zip(corners, (*corners[1:], corners[0]), strict=True):
        end, start = this[:, 2], following[:, 0]
        arcs += [this, np.stack((end, 0.5 * (end + start), start), 1)]
    points = np.stack(arcs, 1)
    return Outline(points, np.ones_like(points[..., 0, 0]) * ([math.sqrt(0.5), 1.0] * 4))


def _nodes(points: Array) -> tuple[Array, Array, Array]:
    """The three control points of arcs (..., 3, 2), each (..., 2)."""
    return points[..., 0, :], points[..., 1, :], points[..., 2, :]
