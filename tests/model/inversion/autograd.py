"""Presses recovered through any differentiable renderer, by autograd: what the fast inversion is compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brushloop.model.inversion.forward import BLOCK_PX, PARAMETERS, Floats, Images, Normal, Rows
from brushloop.model.inversion.noise import Noise
from brushloop.model.inversion.press import TABLE_DEPTHS, TABLE_TILTS, Range, Recovered, limits_of, recover
from brushloop.model.inversion.start import MIN_INK_MM2, Table, moments_of
from brushloop.model.raster.frame import PX_MM

Render = Callable[[Tensor], Tensor]


@dataclass(frozen=True, slots=True)
class Rendered:
    """A `Forward` from a renderer, (B, P) parameters to (B, N, N) images, with derivatives by `torch.func.jvp`.

    It chooses its own placement: its images must be aligned with the targets.
    """

    render: Render
    names: tuple[str, ...] = PARAMETERS[:2]

    def of(self, images: Rows) -> Rendered:
        """See `Forward`."""
        return self

    def predict(self, values: Floats) -> Images:
        """See `Forward`."""
        with torch.no_grad():
            return self.render(torch.from_numpy(values)).float().numpy()

    def normal(self, values: Floats, target: Images, row: Rows) -> Normal:
        """See `Forward`."""
        at = torch.from_numpy(values)
        image = at.new_zeros(0)
        columns: list[Tensor] = []
        for k in range(at.shape[1]):
            along = torch.zeros_like(at)
            along[:, k] = 1
            made: Any = torch.func.jvp(self.render, (at,), (along,))
            image, column = made[0].detach(), made[1].detach()
            columns.append(column.double())
        wanted = torch.from_numpy(target[row]).double()
        residual = wanted - image.double()
        jacobian = torch.stack(columns, dim=1)
        flat = jacobian.flatten(2)
        scores = _block_sums(jacobian * residual[:, None])
        edge = torch.stack((wanted[:, 0], wanted[:, -1], wanted[:, :, 0], wanted[:, :, -1])).amax((0, 2))
        sums = (
            flat @ flat.mT,
            (flat @ residual.flatten(1)[..., None])[..., 0],
            residual.square().sum((1, 2)),
            scores @ scores.mT,
            edge,
        )
        return Normal(*(part.numpy() for part in sums))


def _block_sums(images: Tensor) -> Tensor:
    """(B, P, N, N) summed over squares of BLOCK_PX, (B, P, blocks)."""
    size = images.shape[-1]
    short = -size % BLOCK_PX
    padded = torch.nn.functional.pad(images, (0, short, 0, short))
    parts = padded.unflatten(-1, (-1, BLOCK_PX)).unflatten(-3, (-1, BLOCK_PX))
    return parts.sum((-1, -3)).flatten(-2)


def invert_rendered(
    render: Render,
    images: NDArray[np.floating[Any]],
    within: Range,
    *,
    anchored: bool = False,
    noise: Noise = Noise.PIXEL,
    px_mm: float = PX_MM,
) -> Recovered:
    """Recover (H, alpha) through a renderer, (B, 2) to (B, N, N), from images that are aligned as it draws.

    `anchored` means aligned on the zero-touch point. The fit starts from the nearest image, by area, place and spread,
    of a table that the renderer draws.
    """
    target = np.ascontiguousarray(images, np.float32)
    seen = moments_of(target, px_mm)
    forward = Rendered(render)
    heights = np.linspace(*within.depth_mm, TABLE_DEPTHS)
    table = Table.of(forward, heights, np.linspace(*within.tilt_deg, TABLE_TILTS), (0.0, 0.0), px_mm)
    none = np.zeros(len(target))
    start = table.nearest(seen, np.zeros((len(target), 2)), none)[:, :2]
    full = np.column_stack((start, np.zeros((len(target), 3))))
    limits = limits_of(PARAMETERS[:2], {"depth_mm": within.depth_mm, "tilt_deg": within.tilt_deg})
    return recover(forward, target, full, limits, noise, seen.area < MIN_INK_MM2, alpha_known=anchored, near_mm=px_mm)
