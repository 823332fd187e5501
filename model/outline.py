"""Shapes of strokes: the interface that a raster needs, and the outline of a shape, a loop of conic arcs.

A conic arc is a quadratic Bezier curve with a weight w on its middle point (L. Piegl and W. Tiller, "The NURBS
Book", 2nd ed., ch. 7): w = 1 is a parabola or, with the middle point halfway, a straight line; 0 < w < 1 is an arc
of an ellipse that spans 2 acos(w) of it. So lines, circles, ellipses and CCD-BSM's parabolas are exact; other
curves are cut into short parabolas by `through`.

The frame is defined in `model.raster.frame`. All parameters are batched: one shape per row, `(B,)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Shape(Protocol):
    """A batch of B shapes in the stroke frame; lengths in mm."""

    @property
    def x_min_mm(self) -> Tensor:
        """The end of the shape on the tip side, (B,)."""
        ...

    @property
    def x_max_mm(self) -> Tensor:
        """The end of the shape on the heel side, (B,)."""
        ...

    @property
    def width_mm(self) -> Tensor:
        """The extent along y, (B,)."""
        ...

    @property
    def area_mm2(self) -> Tensor:
        """The area of the whole shape (both halves) in closed form, (B,)."""
        ...

    def outline(self) -> Outline:
        """The boundary as a closed loop of conic arcs."""
        ...


def safe_sqrt(value: Tensor) -> Tensor:
    """The square root of max(value, 0), any shape, with gradient 0 rather than infinity where value <= 0."""
    positive = value > 0
    # Both branches of `where` are differentiated, so the unused one has to be finite as well.
    return torch.where(positive, torch.where(positive, value, torch.ones_like(value)).sqrt(), torch.zeros_like(value))


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """B closed loops of K conic arcs, mm: `points` (B, K, 3, 2) and `weights` (B, K), 0 < w <= 1.

    Each arc ends where the next begins, and a loop runs counter-clockwise with x to the right and y up. Where a
    loop that crosses itself winds twice around an area, the area is drawn once.
    """

    points: Tensor
    weights: Tensor

    def outline(self) -> Outline:
        """Itself: an outline is a shape."""
        return self

    @property
    def x_min_mm(self) -> Tensor:
        """The least x, (B,)."""
        return self._extreme(0, -1)

    @property
    def x_max_mm(self) -> Tensor:
        """The greatest x, (B,)."""
        return self._extreme(0, 1)

    @property
    def width_mm(self) -> Tensor:
        """The extent along y, (B,)."""
        return self._extreme(1, 1) - self._extreme(1, -1)

    @property
    def area_mm2(self) -> Tensor:
        """The enclosed area by Green's theorem, (B,): the polygon of the arcs' ends plus a segment under each."""
        start, middle, end = self.points.unbind(2)
        polygon = 0.5 * cross(start, end)
        # A parabola fills two thirds of its triangle (Archimedes).
        parabola = cross(middle - start, end - start) / 3
        curved = self.weights < 1
        w = torch.where(curved, self.weights, torch.full_like(self.weights, 0.5))
        _, along, across = ellipse_of(self.points, w)
        sine = safe_sqrt((1 - w) * (1 + w))
        segment = cross(along, across) * (torch.atan2(sine, w) - sine * w)
        return (polygon + torch.where(curved, segment, parabola)).sum(-1)

    def at(self, t: Tensor) -> Tensor:
        """Evaluate every arc at t in [0, 1]: (N,) -> (B, K, N, 2) mm."""
        return evaluate(self.points[:, :, None], self.weights[:, :, None], t)

    def polyline(self, per_arc: int = 32) -> Tensor:
        """Points on the loop in order, per_arc on each arc, (B, K per_arc, 2) mm; the last joins the first."""
        if per_arc < 1:
            raise ValueError(f"per_arc = {per_arc}: expected at least one point per arc")
        t = torch.arange(per_arc, dtype=self.points.dtype, device=self.points.device) / per_arc
        return self.at(t).flatten(1, 2)

    def _extreme(self, axis: int, sign: int) -> Tensor:
        """The greatest of sign * coordinate over each loop, times sign, (B,)."""
        p0, p1, p2 = (sign * self.points[..., axis]).unbind(2)
        ends = torch.maximum(p0, p2)
        # An arc leaves the span of its ends only if its middle point does.
        w = self.weights
        curved = w < 1
        safe = torch.where(curved, w, torch.full_like(w, 0.5))
        centre, along, across = (sign * part[..., axis] for part in ellipse_of(self.points, safe))
        ellipse = centre + safe_sqrt(along**2 + across**2)
        bend = p0 - 2 * p1 + p2
        parabola = p0 - (p0 - p1) ** 2 / torch.where(bend == 0, torch.ones_like(bend), bend)
        beyond = torch.where(curved, ellipse, parabola)
        return sign * torch.where(p1 > ends, beyond, ends).amax(-1)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """The z part of the cross product of plane vectors, (..., 2), (..., 2) -> (...)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def ellipse_of(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centre C and half axes E, F of arcs of ellipses, (..., 3, 2), (...) -> three (..., 2).

    The arc is C + E cos u + F sin u for |u| <= acos(w); E points to the middle of the arc. Requires 0 < w < 1.
    """
    start, middle, end = points.unbind(-2)
    w = weights.unsqueeze(-1)
    chord = 0.5 * (start + end)
    centre = middle + (chord - middle) / ((1 - w) * (1 + w))
    return centre, (chord - centre) / w, 0.5 * (end - start) / safe_sqrt((1 - w) * (1 + w))


def evaluate(points: Tensor, weights: Tensor, t: Tensor) -> Tensor:
    """Conic arcs at t, broadcast: (..., 3, 2), (...), (...) -> (..., 2)."""
    b0, b1, b2 = (1 - t) ** 2, 2 * weights * t * (1 - t), t**2
    shares = torch.stack(torch.broadcast_tensors(b0, b1, b2), dim=-1)
    shares = shares / shares.sum(-1, keepdim=True)
    return (shares.unsqueeze(-1) * points).sum(-2)


def loop(*arcs: tuple[Sequence[Tensor], float | Tensor]) -> Outline:
    """Make an outline from one ((x0, y0, x1, y1, x2, y2), weight) per arc, every number (B,)."""
    points = torch.stack([torch.stack(list(numbers), dim=-1) for numbers, _ in arcs], dim=1)
    weights = [torch.as_tensor(w, dtype=points.dtype, device=points.device).expand(len(points)) for _, w in arcs]
    return Outline(points.unflatten(-1, (3, 2)), torch.stack(weights, dim=1))


def through(curve: Tensor) -> Tensor:
    """Parabolas through a finely sampled curve, (B, 2 N + 1, 2) -> (B, N, 3, 2): each takes three points.

    The error falls with the third power of the step; its sign changes within a piece, so areas keep the fourth.
    """
    start, on, end = curve[:, :-1:2], curve[:, 1::2], curve[:, 2::2]
    return torch.stack((start, 2 * on - 0.5 * (start + end), end), dim=2)
