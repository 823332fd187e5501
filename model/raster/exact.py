"""Exact area coverage of any outline at any heading and place, in plain torch on any device, differentiable.

The outline is cut into parabolas shorter than a pixel, and these are cut where they cross pixel edges. A piece within
one cell adds its area to that cell and its full height to the cells on the right, by a running sum along the row.
The derivative of a pixel's coverage is the flow of the boundary inside that pixel (Reynolds' transport theorem),
dA = integral of (dx dy' - dy dx'), so gradients are polynomials that need no square root and no running sum;
first derivatives are exact, in reverse and forward mode. Second derivatives are not supported.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd import forward_ad

from brushloop.model.arrays import Array
from brushloop.model.outline import Outline, evaluate
from brushloop.model.raster import PX_MM, SIZE_PX, check_raster, to_pixels

_CHUNK = 16  # images at a time: about 2,500 pieces each, a dozen numbers per piece
_LEAST_CUTS = 24  # parabolas per arc of an ellipse: the error is below 1e-6 of a pixel for any radius


def coverage_at(
    outline: Outline,
    origin_mm: Array,
    heading_deg: Array = 0.0,
    *,
    size_px: int = SIZE_PX,
    px_mm: float = PX_MM,
) -> Tensor:
    """The covered share of every pixel, (B, size_px, size_px) in [0, 1], of B outlines of torch or numpy.

    `origin_mm` (2,) or (B, 2) and `heading_deg` scalar or (B,) as in `model.raster`. Differentiable in the outline's
    parameters, the origin and the heading. dtype and device are the outline's. Raises ValueError for a size or outline
    that makes no image. The error stays below 1e-6 in float64 and 1e-3 in float32.
    """
    check_raster(size_px, px_mm)
    points, weights = torch.as_tensor(outline.points), torch.as_tensor(outline.weights)
    kind = points.dtype
    # Always in double precision: the share of a pixel is a small difference of positions in the image.
    wide = kind if points.device.type == "mps" else torch.float64
    m = to_pixels(origin_mm, heading_deg, px_mm, weights.to(wide))[:, None, None]
    x, y = points.to(wide).unbind(-1)
    placed = torch.stack((m[..., 0] * x + m[..., 1] * y + m[..., 2], m[..., 3] * x + m[..., 4] * y + m[..., 5]), -1)
    if len(points) == 0:
        return points.new_zeros((0, size_px, size_px))
    parts = zip(placed.split(_CHUNK), weights.to(wide).split(_CHUNK), strict=True)
    return torch.cat([_draw(Outline(p, w), size_px).to(kind) for p, w in parts])


def _draw(outline: Outline, size: int) -> Tensor:
    """The coverage of outlines given in pixels, (C, size, size)."""
    x, y = _short(outline)
    still_x, still_y = x.detached(), y.detached()
    cuts = _cuts(still_x, still_y)
    low, high = cuts[..., :-1], cuts[..., 1:]
    middle = 0.5 * (low + high)
    column, row = still_x.at(middle).floor(), still_y.at(middle).floor()
    # A margin cell on either side of each row and one row below collect what lies outside the image.
    row = torch.where((row >= 0) & (row < size), row, torch.full_like(row, size))
    cell = (row * (size + 2) + column.clamp(-1, size) + 1).long().flatten(1)
    drop = still_y.at(high) - still_y.at(low)
    beyond = _integral(still_x, still_y, low, high) - column * drop  # height for the cells to the right
    # Left of the image, a piece adds its whole drop to the first column; right of the image, it adds nothing.
    beyond = torch.where(column < 0, drop, beyond)
    drop, beyond = (torch.where(column >= size, torch.zeros_like(drop), part).flatten(1) for part in (drop, beyond))
    empty = drop.new_zeros((len(drop), (size + 1) * (size + 2)))
    steps = empty.scatter_add(1, cell, drop - beyond).scatter_add_(1, (cell + 1).clamp_(max=empty.shape[1] - 1), beyond)
    image = _inner(steps.unflatten(1, (size + 1, size + 2)).cumsum(-1), size).clamp(0, 1)
    if not _wants_gradient(x.start):
        return image
    flow = _integral(y, still_x, low, high) - _integral(x, still_y, low, high)
    moved = _inner(empty.scatter_add(1, cell, flow.flatten(1)).unflatten(1, (size + 1, size + 2)), size)
    return image + (moved - moved.detach())


def _inner(grid: Tensor, size: int) -> Tensor:
    """The image without its margins, (C, size + 1, size + 2) -> (C, size, size)."""
    return grid[:, :size, 1 : size + 1]


def _wants_gradient(value: Tensor) -> bool:
    """Whether a reverse or a forward derivative is being taken through `value`."""
    return value.requires_grad or forward_ad.unpack_dual(value).tangent is not None


@dataclass(frozen=True, slots=True, eq=False)
class _Polynomial:
    """One coordinate of short parabolas, start + slope s + bend s^2 for s in [0, 1], each (C, N, 1)."""

    start: Tensor
    slope: Tensor
    bend: Tensor

    def at(self, s: Tensor) -> Tensor:
        return (self.bend * s + self.slope) * s + self.start

    def detached(self) -> _Polynomial:
        return _Polynomial(self.start.detach(), self.slope.detach(), self.bend.detach())


def _short(outline: Outline) -> tuple[_Polynomial, _Polynomial]:
    """Both coordinates of the outline as parabolas that span less than a pixel each way."""
    points, weights = outline.points, outline.weights
    still, w = points.detach(), weights.detach()
    edges = torch.linalg.vector_norm(still.diff(dim=2), dim=-1).amax(-1)
    chord = torch.linalg.vector_norm(still[:, :, 2] - still[:, :, 0], dim=-1)
    # The speed of a conic arc is greatest at an end or in the middle.
    speed = 2 * torch.maximum(edges, chord / (1 + w))
    cuts = (speed / 0.95).ceil().clamp(min=1).amax(0)
    cuts = torch.where((w < 1).any(0), cuts.clamp(min=_LEAST_CUTS), cuts).long()
    arc = torch.repeat_interleave(torch.arange(len(cuts), device=cuts.device), cuts)
    step = torch.arange(len(arc), device=cuts.device) - (cuts.cumsum(0) - cuts)[arc]
    # Equal angles rather than equal t: parabolas then approximate an arc of an ellipse to fourth order.
    half_angle = torch.acos(w.clamp(max=1 - 1e-9))[:, arc]
    points, weights = points[:, arc], weights[:, arc]
    start, on, end = (
        evaluate(points, weights, _even(half_angle, (step + k).to(points) / cuts[arc])) for k in (0, 0.5, 1)
    )
    slope, bend = 4 * on - 3 * start - end, 2 * (start + end) - 4 * on
    x, y = (_Polynomial(start[..., k, None], slope[..., k, None], bend[..., k, None]) for k in (0, 1))
    return x, y


def _even(half_angle: Tensor, share: Tensor) -> Tensor:
    """The t at which a conic arc reaches a share of its angle: t : (1 - t) = sin(share u) : sin((1 - share) u)."""
    before, after = torch.sin(share * half_angle), torch.sin((1 - share) * half_angle)
    return before / (before + after)


def _cuts(x: _Polynomial, y: _Polynomial) -> Tensor:
    """Where short parabolas enter and leave cells, in order, (C, N, 6): 0, the crossings, 1."""
    a, b, c, d = (*_crossings(x), *_crossings(y))
    a, b, c, d = torch.minimum(a, b), torch.maximum(a, b), torch.minimum(c, d), torch.maximum(c, d)
    low, high = torch.minimum(a, c), torch.maximum(b, d)
    b, c = torch.maximum(a, c), torch.minimum(b, d)
    inner = (low, torch.minimum(b, c), torch.maximum(b, c), high)
    return torch.cat((torch.zeros_like(low), *inner, torch.ones_like(low)), dim=-1)


def _crossings(p: _Polynomial) -> tuple[Tensor, Tensor]:
    """The two s at which a short parabola crosses the only pixel edge within its span; 0 for no crossing."""
    end = p.start + p.slope + p.bend
    one = torch.ones_like(end)
    turn = -p.slope / torch.where(p.bend == 0, one, 2 * p.bend)
    peak = torch.where((turn > 0) & (turn < 1) & (p.bend != 0), p.at(turn), p.start)
    top = torch.maximum(torch.maximum(p.start, end), peak)
    bottom = torch.minimum(torch.minimum(p.start, end), peak)
    edge = top.floor()
    rise = edge - p.start
    root = (p.slope**2 + 4 * p.bend * rise).clamp(min=0).sqrt()
    sum_ = p.slope + torch.where(p.slope < 0, -root, root)  # no cancellation
    first = 2 * rise / torch.where(sum_ == 0, one, sum_)
    second = -sum_ / torch.where(p.bend == 0, one, 2 * p.bend)
    crosses = edge > bottom
    return tuple(torch.where(crosses & (s > 0) & (s < 1), s, torch.zeros_like(s)) for s in (first, second))  # pyright: ignore[reportReturnType]


def _integral(p: _Polynomial, q: _Polynomial, low: Tensor, high: Tensor) -> Tensor:
    """The integral of p dq over each cut, (C, N, 5)."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # Around the middle of a cut only even powers contribute: p = p0 + p1 u + p2 u^2, q' = q1 + 2 q2 u.
    p0, p1 = p.at(middle), p.slope + 2 * p.bend * middle
    q1 = q.slope + 2 * q.bend * middle
    return 2 * half * (p0 * q1 + half**2 / 3 * (p.bend * q1 + 2 * p1 * q.bend))
