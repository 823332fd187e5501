"""The outline of a mark: a closed loop of conic arcs.

A conic arc is a quadratic Bezier curve with a weight w on its middle point (L. Piegl and W. Tiller, "The NURBS
Book", 2nd ed., ch. 7): w = 1 is a parabola or, with the middle point halfway, a straight line; 0 < w < 1 is an arc
of an ellipse that spans 2 acos(w) of it. So lines, circles, ellipses and CCD-BSM's parabolas are exact; other
curves are cut into short parabolas by `through`.

The frame is defined in `model.raster`. All parameters are batched: one mark per row, `(B,)`. Everything here computes
in numpy or, with gradients, in torch (`model.arrays`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brushloop.model.arrays import Array, library, like, safe_sqrt


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
        xp = library(self.points)
        start, middle, end = _nodes(self.points)
        polygon = 0.5 * cross(start, end)
        # A parabola fills two thirds of its triangle (Archimedes).
        parabola = cross(middle - start, end - start) / 3
        curved = self.weights < 1
        w = xp.where(curved, self.weights, xp.full_like(self.weights, 0.5))
        _, along, across = ellipse_of(self.points, w)
        sine = safe_sqrt((1 - w) * (1 + w))
        segment = cross(along, across) * (xp.arctan2(sine, w) - sine * w)
        return (polygon + xp.where(curved, segment, parabola)).sum(-1)

    def polyline(self, per_arc: int = 32) -> Array:
        """Points on the loop in order, per_arc on each arc, (B, K per_arc, 2) mm; the last joins the first."""
        if per_arc < 1:
            raise ValueError(f"per_arc = {per_arc}: expected at least one point per arc")
        t = like(np.arange(per_arc) / per_arc, self.points)
        points = evaluate(self.points[:, :, None], self.weights[:, :, None], t)
        return points.reshape(len(points), -1, 2)

    def _extreme(self, axis: int, sign: int) -> Array:
        """The greatest of sign * coordinate over each loop, times sign, (B,)."""
        xp = library(self.points)
        p0, p1, p2 = (sign * node[..., axis] for node in _nodes(self.points))
        ends = xp.maximum(p0, p2)
        # An arc leaves the span of its ends only if its middle point does.
        curved = self.weights < 1
        w = xp.where(curved, self.weights, xp.full_like(self.weights, 0.5))
        centre, along, across = (sign * part[..., axis] for part in ellipse_of(self.points, w))
        ellipse = centre + safe_sqrt(along**2 + across**2)
        bend = p0 - 2 * p1 + p2
        parabola = p0 - (p0 - p1) ** 2 / xp.where(bend == 0, xp.ones_like(bend), bend)
        beyond = xp.where(curved, ellipse, parabola)
        return sign * xp.amax(xp.where(p1 > ends, beyond, ends), -1)


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
    return library(curve).stack((start, 2 * on - 0.5 * (start + end), end), 2)


def closed(*curves: Array) -> Outline:
    """The outline of parabolas through finely sampled curves (B, 2 N + 1, 2), joined by straight lines in order."""
    xp = library(*curves)
    arcs: list[Array] = []
    for curve, following in zip(curves, (*curves[1:], curves[0]), strict=True):
        end, start = curve[:, -1], following[:, 0]
        arcs += [through(curve), xp.stack((end, 0.5 * (end + start), start), 1)[:, None]]
    points = xp.concat(arcs, 1)
    return Outline(points, xp.ones_like(points[..., 0, 0]))


def rounded(centre: Array, half_x: Array, half_y: Array, corner_x: Array, corner_y: Array) -> Outline:
    """A box around (centre, 0) with quarter-ellipse corners, all (B,) mm: four corners, each with the side after it.

    Corners as large as the box make an ellipse, whose sides have no length.
    """
    xp = library(centre)
    flat_x, flat_y = half_x - corner_x, half_y - corner_y
    corners: list[Array] = []
    for k, (right, up) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        side = xp.stack((centre + right * half_x, up * flat_y), -1)
        top = xp.stack((centre + right * flat_x, up * half_y), -1)
        corner = xp.stack((centre + right * half_x, up * half_y), -1)
        corners.append(xp.stack((side, corner, top) if k % 2 == 0 else (top, corner, side), 1))
    arcs: list[Array] = []
    for this, following in zip(corners, (*corners[1:], corners[0]), strict=True):
        end, start = this[:, 2], following[:, 0]
        arcs += [this, xp.stack((end, 0.5 * (end + start), start), 1)]
    points = xp.stack(arcs, 1)
    return Outline(points, xp.ones_like(points[..., 0, 0]) * like([math.sqrt(0.5), 1.0] * 4, points))


def _nodes(points: Array) -> tuple[Array, Array, Array]:
    """The three control points of arcs (..., 3, 2), each (..., 2)."""
    return points[..., 0, :], points[..., 1, :], points[..., 2, :]
