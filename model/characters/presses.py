"""Trajectories as presses laid over each other along the path, and refined until their image is the wanted one.

A pixel is as dark as the darkest mark on it: ink on ink stays ink. Bristles do not lag, and no brush runs dry.
`model.characters.plan.lead` plans with a brush that is dragged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import gaussian_filter

from brushloop.model.characters.plan import Floats, Image, Patch, Reach, StrokePath, directions, lengths_along, tangents
from brushloop.model.raster import SIZE_PX, Images, coverage
from brushloop.model.strokes import StrokeModel

_RATE = np.array([0.12, 0.12, 0.12, 0.1, 1.5])
"""Longest step of x, y, H (mm), alpha and heading (deg)."""
_STIFF = np.array([0.02, 0.02, 0.02, 0.002, 2e-5])
"""Weight of the squared second difference along a stroke."""
_NUDGE = np.array([1e-3, 1e-3, -1e-3, 1e-3, 1e-2])
"""Change of x, y, H (mm), alpha and heading (deg) for their derivatives: it leads into a model's range, not out."""
_WIDE_PX, _NARROW_PX = 2.0, 0.6
_MOMENTUM, _MEMORY = 0.8, 0.95
"""Share of the earlier gradients, and of their squares, that Adam keeps in each step."""
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


class Stamps:
    """Marks of presses at (M, 5) points, laid over each other on a patch: `image`, (size, size), and its derivatives.

    Each mark is drawn on a tile of its own, cut out of the image with a margin all around.
    """

    def __init__(self, model: StrokeModel, presses: Floats, side_mm: float, size_px: int = SIZE_PX) -> None:
        self._model, self._presses, self._side_mm, self._px_mm = model, presses, side_mm, side_mm / size_px
        outline = model.profile(presses[:, 2], presses[:, 3])
        reach_mm = np.maximum(-outline.x_min_mm, outline.x_max_mm) + 0.5 * outline.width_mm
        self._tile = tile = min(math.ceil(2 * float(reach_mm.max()) / self._px_mm) + 2, size_px)
        corner = np.round(self._origins(presses) / self._px_mm - 0.5 * tile).clip(-tile, size_px)
        self._columns, self._rows = (corner.astype(np.int64) + tile).T
        self._marks = self._drawn(presses)
        self._canvas = np.zeros((size_px + 2 * tile, size_px + 2 * tile), np.float32)
        for mark, row, column in zip(self._marks, self._rows, self._columns, strict=True):
            part = self._canvas[row : row + tile, column : column + tile]
            np.maximum(part, mark, out=part)
        self.image: Image = self._canvas[tile : tile + size_px, tile : tile + size_px]

    def slopes(self, weights: Floats) -> Floats:
        """Derivatives (M, 5), by every number of the presses, of the sum over the image times (size, size) weights.

        A pixel follows the mark that is darkest on it.
        """
        visible = self._marks == self._tiles(self._canvas)
        pull = np.where(visible, self._tiles(np.pad(weights, self._tile)), 0.0)
        out = np.empty(self._presses.shape)
        for k, nudge in enumerate(_NUDGE):
            moved = self._drawn(self._presses + nudge * np.eye(5)[k])
            out[:, k] = np.einsum("mij,mij->m", moved - self._marks, pull) / nudge
        return out

    def _tiles(self, canvas: NDArray[Any]) -> NDArray[Any]:
        """What each press's tile shows of an image with margins, (M, tile, tile)."""
        return sliding_window_view(canvas, (self._tile, self._tile))[self._rows, self._columns]

    def _drawn(self, presses: Floats) -> Images:
        """The marks of presses on the tiles, (M, tile, tile)."""
        outline = self._model.profile(presses[:, 2], presses[:, 3])
        corner_mm = (np.column_stack((self._columns, self._rows)) - self._tile) * self._px_mm
        place = self._origins(presses) - corner_mm
        return coverage(outline, place, presses[:, 4], size_px=self._tile, px_mm=self._px_mm)

    def _origins(self, presses: Floats) -> Floats:
        """Where the brush axis meets the paper, (M, 2) mm from the left and the far edge."""
        x, y, depth, tilt, heading = presses.T
        ahead = (depth * np.tan(np.radians(tilt)))[:, None] * directions(heading)
        return np.column_stack((x + ahead[:, 0], self._side_mm - y - ahead[:, 1]))


def written(model: StrokeModel, strokes: Sequence[Floats], side_mm: float, size_px: int = SIZE_PX) -> Image:
    """The image of whole trajectories, each (N, 5), with marks dense enough that edges join to a tenth of a pixel."""
    dense = [_between(stroke, math.ceil(_longest(stroke) * 2 * size_px / side_mm)) @ stroke for stroke in strokes]
    return Stamps(model, np.concatenate(dense), side_mm, size_px).image


def refine(
    model: StrokeModel, strokes: Sequence[Floats], wanted: Image, side_mm: float, reach: Reach, steps: int = 60
) -> list[Floats]:
    """Adjust trajectories, each (N, 5), until their image is `wanted`, (N, N) of the patch, within reach.

    Adam minimises the squared difference of the images, blurred by a Gaussian that narrows, so that an edge that is
    pixels off still has a gradient. After every step `Reach.within` makes the trajectory feasible again. The best
    trajectories are returned; `steps` = 0 leaves them unchanged.
    """
    px_mm = side_mm / len(wanted)
    ends = np.cumsum([len(stroke) for stroke in strokes])[:-1]
    points, best, least = np.concatenate(strokes), list(strokes), math.inf
    bends = block_diag(*(np.diff(np.eye(len(stroke)), 2, axis=0) for stroke in strokes))
    mean, square = np.zeros(points.shape), np.zeros(points.shape)
    for step in range(steps + 1):
        parts = np.split(points, ends)
        between = block_diag(*(_between(part, round(_longest(part) / (2.0 * px_mm))) for part in parts))
        stamps = Stamps(model, between @ points, side_mm, len(wanted))
        off = stamps.image.astype(np.float64) - wanted
        if np.square(off).mean() < least:
            least, best = float(np.square(off).mean()), parts
        if step == steps:
            break
        width_px = _WIDE_PX + (_NARROW_PX - _WIDE_PX) * min(1.0, step / (0.7 * steps))
        # The blur is symmetric, so the derivative of its square is the image blurred twice.
        weights = 2.0 * px_mm**2 * _blurred(_blurred(off, width_px), width_px)
        gradient = _RATE * (between.T @ stamps.slopes(weights) + 2.0 * bends.T @ (bends @ points * _STIFF))
        mean = _MOMENTUM * mean + (1.0 - _MOMENTUM) * gradient
        square = _MEMORY * square + (1.0 - _MEMORY) * gradient**2
        size = np.sqrt(square / (1.0 - _MEMORY ** (step + 1))) + 1e-9
        moved = points - (1.0 - 0.8 * step / steps) * _RATE * mean / (1.0 - _MOMENTUM ** (step + 1)) / size
        points = np.concatenate([reach.within(part, side_mm) for part in np.split(moved, ends)])
    return best


def _between(stroke: Floats, per_step: int) -> Floats:
    """Shares of a stroke's points, (M, N), in presses on the lines between them, `per_step` a line and at least one."""
    at = np.linspace(0.0, len(stroke) - 1.0, (len(stroke) - 1) * max(1, per_step) + 1)
    return np.clip(1.0 - np.abs(at[:, None] - np.arange(len(stroke))), 0.0, 1.0)


def _longest(stroke: Floats) -> float:
    """The longest line between neighbouring points, mm."""
    return float(np.linalg.norm(np.diff(stroke[:, :2], axis=0), axis=1).max())


def _blurred(image: Floats, width_px: float) -> Floats:
    """An image blurred by a Gaussian of that standard deviation, zero outside."""
    return gaussian_filter(image, width_px, mode="constant", truncate=3.0)
