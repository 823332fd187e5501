"""Adjust trajectories until their image matches the wanted one, within the limits of brush and arm.

Adam minimises the squared difference of the images, blurred by a Gaussian that narrows, so that an edge that is pixels
off still has a gradient. After every step `Reach.within` makes the trajectory feasible again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from brushloop.model.characters.brush import Reach
from brushloop.model.characters.drag import dragged, is_dragged
from brushloop.model.characters.ink import Image, dense, stamped
from brushloop.model.drag import DragModel
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]
_RATE = (0.12, 0.12, 0.12, 0.1, 1.5)
"""Longest step of x, y, H (mm), alpha and heading (deg)."""
_STIFF = (0.02, 0.02, 0.02, 0.002, 2e-5)
"""Weight of the squared second difference along a stroke."""
_WIDE_PX, _NARROW_PX = 2.0, 0.6


@dataclass(frozen=True, slots=True)
class Refined:
    """Trajectories, each (N, 5), and the mean square difference of the images before every step."""

    strokes: list[Floats]
    losses: list[float]


def refine(
    model: StrokeModel,
    strokes: Sequence[Floats],
    wanted: Image,
    side_mm: float,
    reach: Reach,
    steps: int = 60,
    *,
    drag: DragModel | None = None,
) -> Refined:
    """Adjust trajectories to an image (N, N) of the cell. `steps` = 0 leaves them unchanged.

    With `drag`, dragged strokes are drawn with that model, so that the plan compensates for bristle lag.
    """
    size = wanted.shape[0]
    target = torch.from_numpy(wanted).double()
    points = torch.from_numpy(np.concatenate(strokes)) if strokes else torch.zeros(0, 5)
    points = points.double().requires_grad_()
    ends = np.cumsum([len(stroke) for stroke in strokes])[:-1].tolist()
    rate, stiff = torch.tensor(_RATE).double(), torch.tensor(_STIFF).double()
    first, second = torch.zeros_like(points), torch.zeros_like(points)
    px_mm = side_mm / size
    losses: list[float] = []
    best, least = [stroke.copy() for stroke in strokes], float("inf")
    for step in range(steps + 1):
        parts = torch.tensor_split(points, ends)
        image = _image(model, drag, parts, side_mm, size)
        plain = float((image.detach() - target).square().mean())
        losses.append(plain)
        if plain < least:
            least, best = plain, [part.detach().numpy().copy() for part in parts]
        if step == steps:
            break
        width = _WIDE_PX + (_NARROW_PX - _WIDE_PX) * min(1.0, step / (0.7 * steps))
        bent = sum(((p[2:] - 2 * p[1:-1] + p[:-2]).square() * stiff).sum() for p in parts)
        loss = _blurred(image - target, width).square().sum() * px_mm**2 + bent
        (slope,) = torch.autograd.grad(loss, points)
        with torch.no_grad():
            first = 0.8 * first + 0.2 * slope
            second = 0.95 * second + 0.05 * slope.square()
            shrunk = 1.0 - 0.8 * step / steps
            grown = (1 - 0.8 ** (step + 1)), (1 - 0.95 ** (step + 1))
            moved = points - shrunk * rate * (first / grown[0]) / ((second / grown[1]).sqrt() + 1e-9)
            feasible = [reach.within(part.numpy(), side_mm) for part in torch.tensor_split(moved, ends)]
            points = torch.from_numpy(np.concatenate(feasible)).requires_grad_()
    return Refined(best, losses)


def _image(model: StrokeModel, drag: DragModel | None, parts: Sequence[Tensor], side_mm: float, size: int) -> Tensor:
    lagging = [drag is not None and is_dragged(part) for part in parts]
    pressed = [dense(p, _per_step(p, side_mm / size)) for p, lags in zip(parts, lagging, strict=True) if not lags]
    layers = [stamped(model, torch.cat(pressed), side_mm, size)] if pressed else []
    if drag is not None:
        layers += [dragged(drag, p, side_mm, size) for p, lags in zip(parts, lagging, strict=True) if lags]
    if not layers:
        return torch.zeros(size, size, dtype=torch.float64)
    return torch.stack(layers).amax(dim=0)


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
