"""A dragged stroke with bristle lag, differentiable in its trajectory: `model.drag` in torch.

The bristles trail, so the ink cuts the corners of the commanded path and begins and ends elsewhere. A plan that is
refined through this image leads the brush ahead of where the ink is wanted. Points are those of
`model.characters.brush`: x and y of the tip, H, alpha (of no effect here) and heading, which turns the model's drift.
"""

from __future__ import annotations

import torch
from torch import Tensor

from brushloop.model.drag import DragModel

LEAST_TRAVEL_MM = 0.5
"""A stroke that travels less than this is a press."""


def is_dragged(points: Tensor) -> bool:
    """Whether (N, 5) points travel."""
    return float(torch.linalg.vector_norm(points.detach()[:, :2].diff(dim=0), dim=1).sum()) >= LEAST_TRAVEL_MM


def trail(model: DragModel, points: Tensor) -> Tensor:
    """Trail of the footprint, as `model.drag.trails`: (N, 5) points -> (N + 2, 3) x, y, half width in mm.

    Raises ValueError for fewer than 2 points.
    """
    if len(points) < 2:
        raise ValueError(f"a drag has at least 2 points, got {len(points)}")
    tip, depths = points[:, :2], points[:, 2]
    steps = tip.diff(dim=0)
    lengths = torch.linalg.vector_norm(steps, dim=1).clamp_min(1e-9)
    ways = steps / lengths[:, None]
    first = ways[int(torch.argmax((lengths.detach() > 1e-8).to(torch.uint8)))]
    place, depth = tip[0] + model.land_mm * first, depths[0]
    places, settled = [place], [depth]
    for k in range(1, len(points)):
        depth = depth + (depths[k] - depth) * (1.0 - torch.exp(-lengths[k - 1] / max(model.settle_mm, 0.05)))
        leash = (model.leash_mm + model.leash_per_mm * depth).clamp_min(0.05)
        lag = leash * ways[k - 1]
        # Exact response to a target at constant speed: a steady lag of one leash, plus a decaying term.
        place = tip[k] - lag - (tip[k - 1] - place - lag) * torch.exp(-lengths[k - 1] / leash)
        places.append(place)
        settled.append(depth)
    at, deep = torch.stack(places), torch.stack(settled)
    turn = torch.deg2rad(points[:, 4])
    along = model.drift_x_mm + model.drift_x_per_mm * deep
    across = model.drift_y_mm + model.drift_y_per_mm * deep
    cos, sin = torch.cos(turn), torch.sin(turn)
    drawn = at + torch.stack((cos * along - sin * across, sin * along + cos * across), dim=1)
    half = model.half_mm + model.half_per_mm * deep + model.half_per_mm2 * deep.square()
    back = drawn[0] - model.back_mm * first
    ahead = drawn[-1] + model.front * (tip[-1] - at[-1])
    ends = torch.stack((half[0], half[-1] * model.front_width))
    middle = torch.cat((drawn, half[:, None]), dim=1)
    return torch.cat((torch.cat((back, ends[:1]))[None], middle, torch.cat((ahead, ends[1:]))[None]))


def dragged(model: DragModel, points: Tensor, side_mm: float, size_px: int) -> Tensor:
    """The image (size, size) of one stroke, given as (N, 5) points on a cell of that side; row 0 at its far edge.

    Ink rises from 0 to 1 over one pixel at the edge. Differentiable in the points: each pixel depends on the disc that
    covers it most deeply.
    """
    nodes = trail(model, points)
    middle = (torch.arange(size_px, dtype=nodes.dtype) + 0.5) * side_mm / size_px
    grid = torch.stack(torch.meshgrid(middle, side_mm - middle, indexing="xy"), dim=-1).reshape(-1, 2)
    with torch.no_grad():
        nearest = torch.argmax(_reach(nodes[None, :-1], nodes[None, 1:], grid[:, None]), dim=1)
    over = _reach(nodes[nearest], nodes[nearest + 1], grid)
    return (0.5 + over * (size_px / side_mm)).clamp(0.0, 1.0).reshape(size_px, size_px)


def _reach(start: Tensor, end: Tensor, at: Tensor) -> Tensor:
    """How deep a point lies inside the discs between two nodes: (..., 3), (..., 3), (..., 2) -> (...) mm.

    The disc at the point's projection onto the segment counts; its position is held constant in gradients.
    """
    way = (end - start)[..., :2]
    off = at - start[..., :2]
    share = ((off * way).sum(-1) / (way.square().sum(-1) + 1e-12)).clamp(0.0, 1.0).detach()
    gap = off - share[..., None] * way
    far = (gap.square().sum(-1) + 1e-18).sqrt()
    return start[..., 2] + share * (end - start)[..., 2] - far
