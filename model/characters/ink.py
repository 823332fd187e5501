"""Images of trajectories: overlaid marks of presses along the path, and outlines of characters.

The image of the cell is square, row 0 at its far (upper) edge. A pixel is as dark as the darkest mark on it: ink on
ink stays ink. With a stroke model, bristles do not lag; with a drag model (`model.drag`, fitted to dragged strokes)
they do. Neither models a brush that runs dry.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brushloop.model.characters.drag import dragged, is_dragged
from brushloop.model.characters.glyph import Glyph
from brushloop.model.characters.plan import Cell, Path, grid
from brushloop.model.drag import DragModel
from brushloop.model.outline import Outline
from brushloop.model.raster import SIZE_PX, coverage
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


def dense(points: Tensor, per_step: int) -> Tensor:
    """(N, 5) points with `per_step` - 1 more interpolated linearly between neighbours, ((N - 1) per_step + 1, 5)."""
    share = torch.arange(per_step, dtype=points.dtype) / per_step
    between = points[:-1, None] + share[:, None] * (points[1:] - points[:-1])[:, None]
    return torch.cat((between.flatten(0, 1), points[-1:]))


def stamped(model: StrokeModel, points: Tensor, side_mm: float, size_px: int = SIZE_PX) -> Tensor:
    """The image (size, size) of presses at (M, 5) points; differentiable in all of them."""
    px_mm = side_mm / size_px
    x, y, height, tilt, heading = points.unbind(-1)
    shape = model.profile(height, tilt)
    turn = torch.deg2rad(heading)
    way = torch.stack((torch.cos(turn), -torch.sin(turn)), dim=-1)
    origin = torch.stack((x, side_mm - y), dim=-1) + (height * torch.tan(torch.deg2rad(tilt)))[:, None] * way
    with torch.no_grad():
        # Each mark is drawn on a separate tile, cut out of the image with a margin all around.
        reach = torch.maximum(-shape.x_min_mm, shape.x_max_mm) + 0.5 * shape.width_mm
        tile = min(math.ceil(2 * float(reach.max()) / px_mm) + 2, size_px)
        corner = (origin / px_mm - 0.5 * tile).round().clamp(-tile, size_px)
    marks = coverage_at(shape, origin - corner * px_mm, heading, size_px=tile, px_mm=px_mm)
    wide = size_px + 2 * tile
    offset = torch.arange(tile)
    rows, columns = ((corner[:, k].long() + tile)[:, None] + offset for k in (1, 0))
    flat = (rows[:, :, None] * wide + columns[:, None, :]).flatten()
    canvas = marks.new_zeros(wide * wide).scatter_reduce(0, flat, marks.flatten(), "amax")
    return canvas.unflatten(0, (wide, wide))[tile : tile + size_px, tile : tile + size_px]


def written(
    model: StrokeModel,
    strokes: Sequence[Floats],
    side_mm: float,
    size_px: int = SIZE_PX,
    *,
    drag: DragModel | None = None,
) -> Image:
    """The image of whole trajectories, each (N, 5), with marks dense enough that edges join to a tenth of a pixel.

    With `drag`, dragged strokes are drawn with that model.
    """
    image = np.zeros((size_px, size_px), np.float32)
    for points in strokes:
        if drag is not None and is_dragged(torch.from_numpy(points)):
            with torch.no_grad():
                image = np.maximum(image, dragged(drag, torch.from_numpy(points), side_mm, size_px).float().numpy())
            continue
        longest = float(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1).max())
        per_step = max(1, math.ceil(longest / (0.5 * side_mm / size_px)))
        with torch.no_grad():
            made = stamped(model, dense(torch.from_numpy(points), per_step), side_mm, size_px)
        image = np.maximum(image, made.float().numpy())
    return image


def reference(glyph: Glyph, cell: Cell, size_px: int = SIZE_PX) -> Image:
    """The image of a character's outlines, with the exact coverage of each stroke."""
    image = np.zeros((size_px, size_px), np.float32)
    for stroke in glyph.strokes:
        points = cell.to_mm(stroke.arcs)[None]
        loop = Outline(points, np.ones(points.shape[:2]))
        drawn = coverage(loop, (0.0, cell.side_mm), size_px=size_px, px_mm=cell.side_mm / size_px)
        image = np.maximum(image, drawn[0])
    return image


def swept(paths: Sequence[Path], side_mm: float, size_px: int = SIZE_PX) -> Image:
    """The image of discs along paths: the intended look of a user's trajectory with widths."""
    x, y = np.meshgrid(*grid(side_mm, size_px))
    image = np.zeros((size_px, size_px))
    for path in paths:
        steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
        along = np.concatenate(([0.0], np.cumsum(steps)))
        at = np.linspace(0, along[-1], max(2, math.ceil(along[-1] / (0.25 * side_mm / size_px))))
        for cx, cy, r in zip(*(np.interp(at, along, v) for v in (*path.points.T, path.half_width_mm)), strict=True):
            edge = (r - np.hypot(x - cx, y - cy)) * size_px / side_mm
            image = np.maximum(image, np.clip(0.5 + edge, 0, 1))
    return image.astype(np.float32)
