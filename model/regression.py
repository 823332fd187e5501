"""Linear regression of stroke parameters on depth and tilt, as Wang and Min do for Bezier strokes.

The paper describes theirs as a least-squares multiple linear regression of the stroke's lengths on the descending
height and the tilt angle. Here the terms are 1, H and H alpha: the effect of tilt is proportional to depth, as is
every length of CCD-BSM, so a regressed stroke stays valid far from the cells. Without captures the regression runs
on CCD-BSM's marks at the cells of the paper and adds no information about real ink.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from brushloop.model.ccdbsm import CcdBsm, as_batch
from brushloop.model.plane import Plane, fit_plane
from brushloop.model.protocol import Basis, Number, Values

# The paper's H and alpha; H as a share of its brush's 48 mm, so that the cells lie in the domain of any brush.
DEPTHS = tuple(depth_mm / 48 for depth_mm in (11.0, 13.0, 15.0, 17.0, 20.0))
TILTS_DEG = (0.0, 5.0, 10.0)


def regressed(basis: Basis, measure: Callable[[CcdBsm], Values]) -> Callable[[Number, Number], Values]:
    """A function (H, alpha) -> parameters: `measure` of CCD-BSM's marks at the paper's cells, regressed on first use.

    The function raises DomainError where CCD-BSM has no mark.
    """
    planes: list[Plane] = []

    def press(depth_mm: Number, tilt_deg: Number) -> Values:
        basis.mark(depth_mm, tilt_deg)
        if not planes:
            length_mm = float(torch.as_tensor(basis.brush.length_mm).detach().reshape(-1)[0])
            cells = torch.cartesian_prod(
                length_mm * torch.tensor(DEPTHS, dtype=torch.float64), torch.tensor(TILTS_DEG, dtype=torch.float64)
            )
            height, tilt = cells.unbind(-1)
            values = measure(basis.mark(height, tilt))
            planes.append(fit_plane(height, tilt, {name: value.detach().cpu() for name, value in values.items()}))
        return planes[0].at(*as_batch(depth_mm, tilt_deg))

    return press


def solve(value: Callable[[Tensor], Tensor], target: Tensor, low: Tensor, high: Tensor, steps: int = 50) -> Tensor:
    """Where an increasing function (B,) -> (B,) reaches `target` between low and high, by bisection; else an end.

    The result carries no gradient.
    """
    with torch.no_grad():
        for _ in range(steps):
            middle = 0.5 * (low + high)
            below = value(middle) < target
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return 0.5 * (low + high)
