"""The outline of a disc that moves along a quadratic Bezier curve while its width changes linearly.

With centre c(t), radius r(t), tangent T, left normal N and k = r' / |c'|, the disc's envelope is
c + r (-k T +- sqrt(1 - k^2) N): the two sides of the stroke. The first and the last disc close the outline.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from brushloop.model.brush import DomainError
from brushloop.model.outline import Outline, evaluate, safe_sqrt, through

_CAP_ARCS = 3  # arcs in a round end: each spans less than 120 degrees


def swept(nodes_mm: Tensor, start_width_mm: Tensor, end_width_mm: Tensor, pieces: int = 64) -> Outline:
    """The strokes with control points (B, 3, 2) and widths (B,), as `pieces` parabolas per side and round ends.

    Raises DomainError if a disc contains its neighbours (the width changes faster than the curve advances) or if a
    bend is tighter than the stroke is thick, so that its inner side folds over. Where a stroke overlaps itself
    elsewhere, `area_mm2` counts the overlap twice and the rasterisers are wrong along its boundary.
    """
    t = torch.linspace(0, 1, 2 * pieces + 1, dtype=nodes_mm.dtype, device=nodes_mm.device)
    centre = evaluate(nodes_mm[:, None], torch.ones_like(t), t)
    steps = 2 * nodes_mm.diff(dim=1)
    velocity = (1 - t)[:, None] * steps[:, :1] + t[:, None] * steps[:, 1:]
    speed = safe_sqrt((velocity**2).sum(-1))
    radius = 0.5 * (start_width_mm[:, None] * (1 - t) + end_width_mm[:, None] * t)
    growth = (0.5 * (end_width_mm - start_width_mm))[:, None]
    held = growth.abs() >= speed
    if held.any():
        at = int(held.any(-1).nonzero()[0])
        allowed = f"{float(start_width_mm[at]):g} +- {float(2 * speed[at].min()):g} mm"
        hint = "the width changes faster than the curve runs"
        raise DomainError("end_width_mm", float(end_width_mm[at]), allowed, hint)
    along = velocity / speed[..., None]
    left = torch.stack((-along[..., 1], along[..., 0]), dim=-1)
    k = growth / speed
    back, aside = -(radius * k)[..., None] * along, (radius * safe_sqrt((1 - k) * (1 + k)))[..., None] * left
    right_side, left_side = centre + back - aside, centre + back + aside
    _check_folds(right_side, left_side, along, nodes_mm)
    heading = torch.atan2(along[..., 1], along[..., 0])
    lean = torch.atan2(safe_sqrt((1 - k) * (1 + k)), -k)  # angle from the tangent to the envelope's point of contact
    end, end_weights = _cap(centre[:, -1], radius[:, -1], heading[:, -1] - lean[:, -1], 2 * lean[:, -1])
    start, start_weights = _cap(centre[:, 0], radius[:, 0], heading[:, 0] + lean[:, 0], 2 * (math.pi - lean[:, 0]))
    points = torch.cat((through(right_side), end, through(left_side.flip(1)), start), dim=1)
    ones = torch.ones((len(points), pieces), dtype=points.dtype, device=points.device)
    return Outline(points, torch.cat((ones, end_weights, ones, start_weights), dim=1))


def _cap(centre: Tensor, radius: Tensor, start: Tensor, span: Tensor) -> tuple[Tensor, Tensor]:
    """A circular arc from the angle `start` over `span`, all (B,): points (B, n, 3, 2) and weights (B, n)."""
    half = span / (2 * _CAP_ARCS)
    k = torch.arange(2 * _CAP_ARCS + 1, dtype=centre.dtype, device=centre.device)
    angle = start[:, None] + k * half[:, None]
    corner = 1 / torch.cos(half)
    reach = radius[:, None] * torch.where(k % 2 == 1, corner[:, None], torch.ones_like(angle))
    points = centre[:, None] + reach[..., None] * torch.stack((torch.cos(angle), torch.sin(angle)), dim=-1)
    arcs = torch.stack((points[:, :-1:2], points[:, 1::2], points[:, 2::2]), dim=2)
    return arcs, torch.cos(half)[:, None].expand(-1, _CAP_ARCS)


def _check_folds(right: Tensor, left: Tensor, along: Tensor, nodes: Tensor) -> None:
    """Raise DomainError unless both sides run forward with the curve."""
    tangent = along[:, 1:] + along[:, :-1]
    folded = torch.stack([(side.diff(dim=1) * tangent).sum(-1) < 0 for side in (right, left)]).any(0).any(-1)
    if folded.any():
        at = int(folded.nonzero()[0])
        raise DomainError("x1_mm", float(nodes[at, 1, 0]), "a curve whose bends are wider than the stroke is thick")
