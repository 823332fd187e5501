"""Trajectories as presses laid over each other along the path, and refined until their image is the wanted one.

A pixel is as dark as the darkest mark on it: ink on ink stays ink. Bristles do not lag, and no brush runs dry.
`model.characters.plan.lead` plans with a brush that is dragged, and needs no torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from brushloop.model.arrays import Array, library, like
from brushloop.model.characters.plan import (
    Floats,
    Image,
    Patch,
    Reach,
    StrokePath,
    directions,
    lengths_along,
    tangents,
)
from brushloop.model.raster import SIZE_PX, coverage
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import StrokeModel

_RATE = (0.12, 0.12, 0.12, 0.1, 1.5)
"""Longest step of x, y, H (mm), alpha and heading (deg)."""
_STIFF = (0.02, 0.02, 0.02, 0.002, 2e-5)
"""Weight of the squared second difference along a stroke."""
_WIDE_PX, _NARROW_PX = 2.0, 0.6
_TABLE = 64


def trajectory(path: StrokePath, model: StrokeModel, reach: Reach, patch: Patch, tilt_deg: float) -> Floats:
    """Points (N, 5) of x, y, H, alpha, heading along a path.

    The tip trails behind the axis, so the depth near the beginning is limited to keep the tip within the stroke.
    """
    points, half = path.points, path.half_width_mm
    depth = depth_of(model, reach, tilt_deg, half)
    median_mm = float(np.median(depth))
    behind = -float(model.profile(median_mm, tilt_deg).x_min_mm[0]) / median_mm
    depth = np.minimum(depth, (lengths_along(points) + half[0]) / behind)
    heading = tangents(points)
    ahead = (depth * np.tan(np.radians(tilt_deg)))[:, None]
    tip = points - ahead * directions(heading)
    return reach.within(np.column_stack((tip, depth, np.full(len(points), tilt_deg), heading)), patch.side_mm)


def depth_of(model: StrokeModel, reach: Reach, tilt_deg: float, half_width_mm: Floats) -> Floats:
    """The depths at which presses have these half widths, clipped to the feasible range, (N,) -> (N,) mm."""
    depths = np.linspace(*reach.depth_mm, _TABLE)
    widths = model.profile(depths, tilt_deg).width_mm
    return np.interp(2 * half_width_mm, np.maximum.accumulate(widths), depths)


def dense(points: Array, per_step: int) -> Array:
    """(N, 5) points with `per_step` - 1 more interpolated linearly between neighbours, ((N - 1) per_step + 1, 5)."""
    share = like(np.arange(per_step) / per_step, points)[:, None]
    between = points[:-1, None] + share * (points[1:] - points[:-1])[:, None]
    return library(points).concat((between.reshape(-1, points.shape[1]), points[-1:]))


def origins(points: Array, side_mm: float) -> Array:
    """Where the brush axis meets the paper in presses at (M, 5) points, (M, 2) mm from the left and the far edge."""
    xp = library(points)
    x, y, depth, tilt, heading = (points[:, k] for k in range(5))
    ahead, turn = depth * xp.tan(xp.deg2rad(tilt)), xp.deg2rad(heading)
    return xp.stack((x + ahead * xp.cos(turn), side_mm - y - ahead * xp.sin(turn)), -1)


def stamped(model: StrokeModel, points: Tensor, side_mm: float, size_px: int = SIZE_PX) -> Tensor:
    """The image (size, size) of presses at (M, 5) points; differentiable in all of them."""
    px_mm = side_mm / size_px
    shape, origin = model.profile(points[:, 2], points[:, 3]), origins(points, side_mm)
    with torch.no_grad():
        # Each mark is drawn on a separate tile, cut out of the image with a margin all around.
        reach = torch.maximum(-shape.x_min_mm, shape.x_max_mm) + 0.5 * shape.width_mm
        tile = min(math.ceil(2 * float(reach.max()) / px_mm) + 2, size_px)
        corner = (origin / px_mm - 0.5 * tile).round().clamp(-tile, size_px)
    marks = coverage_at(shape, origin - corner * px_mm, points[:, 4], size_px=tile, px_mm=px_mm)
    wide = size_px + 2 * tile
    offset = torch.arange(tile)
    rows, columns = ((corner[:, k].long() + tile)[:, None] + offset for k in (1, 0))
    flat = (rows[:, :, None] * wide + columns[:, None, :]).flatten()
    canvas = marks.new_zeros(wide * wide).scatter_reduce(0, flat, marks.flatten(), "amax")
    return canvas.unflatten(0, (wide, wide))[tile : tile + size_px, tile : tile + size_px]


def written(model: StrokeModel, strokes: Sequence[Floats], side_mm: float, size_px: int = SIZE_PX) -> Image:
    """The image of whole trajectories, each (N, 5), with marks dense enough that edges join to a tenth of a pixel."""
    px_mm = side_mm / size_px
    image = np.zeros((size_px, size_px), np.float32)
    for points in strokes:
        longest = float(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).max())
        presses = dense(points, max(1, math.ceil(longest / (0.5 * px_mm))))
        shape, origin = model.profile(presses[:, 2], presses[:, 3]), origins(presses, side_mm)
        image = np.maximum(image, coverage(shape, origin, presses[:, 4], size_px=size_px, px_mm=px_mm).max(axis=0))
    return image


def refine(
    model: StrokeModel, strokes: Sequence[Floats], wanted: Image, side_mm: float, reach: Reach, steps: int = 60
) -> list[Floats]:
    """Adjust trajectories, each (N, 5), until their image is `wanted`, (N, N) of the patch, within reach.

    Adam minimises the squared difference of the images, blurred by a Gaussian that narrows, so that an edge that is
    pixels off still has a gradient. After every step `Reach.within` makes the trajectory feasible again. The best
    trajectories are returned; `steps` = 0 leaves them unchanged.
    """
    size = len(wanted)
    target = torch.from_numpy(wanted).double()
    ends = np.cumsum([len(stroke) for stroke in strokes])[:-1].tolist()
    rate, stiff = torch.tensor(_RATE).double(), torch.tensor(_STIFF).double()
    scaled = (torch.from_numpy(np.concatenate(strokes)).double() / rate).requires_grad_()
    adam = torch.optim.Adam([scaled], lr=1.0, betas=(0.8, 0.95), eps=1e-9)
    best, least = [stroke.copy() for stroke in strokes], float("inf")
    for step in range(steps + 1):
        parts = torch.tensor_split(scaled * rate, ends)
        pressed = [dense(part, _per_step(part, side_mm / size)) for part in parts]
        off = stamped(model, torch.cat(pressed), side_mm, size) - target
        plain = float(off.detach().square().mean())
        if plain < least:
            least, best = plain, [part.detach().numpy().copy() for part in parts]
        if step == steps:
            break
        width = _WIDE_PX + (_NARROW_PX - _WIDE_PX) * min(1.0, step / (0.7 * steps))
        bent = sum(((p[2:] - 2 * p[1:-1] + p[:-2]).square() * stiff).sum() for p in parts)
        adam.param_groups[0]["lr"] = 1.0 - 0.8 * step / steps
        adam.zero_grad()
        loss = _blurred(off, width).square().sum() * (side_mm / size) ** 2 + bent
        loss.backward()
        adam.step()
        with torch.no_grad():
            feasible = [reach.within(part.numpy(), side_mm) for part in torch.tensor_split(scaled * rate, ends)]
            scaled.copy_(torch.from_numpy(np.concatenate(feasible)) / rate)
    return best


def _per_step(part: Tensor, px_mm: float) -> int:
    longest = float(torch.linalg.vector_norm(part.detach()[:, :2].diff(dim=0), dim=1).max())
    return max(1, round(longest / (2.0 * px_mm)))


def _blurred(image: Tensor, width_px: float) -> Tensor:
    """An image blurred by a Gaussian of that standard deviation, zero outside."""
    reach = max(1, round(3 * width_px))
    at = torch.arange(-reach, reach + 1, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (at / width_px) ** 2)
    kernel = kernel / kernel.sum()
    out = torch.nn.functional.conv2d(image[None, None], kernel[None, None, :, None], padding=(reach, 0))
    return torch.nn.functional.conv2d(out, kernel[None, None, None, :], padding=(0, reach))[0, 0]
