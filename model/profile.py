"""What a stroke shape has to offer so that it can be rasterised exactly, and the closed forms shapes share.

Every shape has an outline, which can be drawn at any heading. A profile is a shape that is symmetric about the x
axis and whose half width w(x) rises to one plateau or peak and falls again on [x_min, x_max], so that every level
set {x : w(x) >= a} is one interval. The frame is defined in `model.raster.frame`. All parameters are batched: one
shape per row, `(B,)`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

if TYPE_CHECKING:
    from model.outline import Outline


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
        """The extent along y; for a profile, the full width at the widest place, (B,)."""
        ...

    @property
    def area_mm2(self) -> Tensor:
        """The area of the whole shape (both halves) in closed form, (B,)."""
        ...

    def outline(self) -> Outline:
        """The boundary as a closed loop of conic arcs."""
        ...


@runtime_checkable
class Profile(Shape, Protocol):
    """A batch of B shapes symmetric about the x axis with a unimodal half width."""

    def half_width(self, x_mm: Tensor) -> Tensor:
        """The half width w at x, (B, N) -> (B, N); zero outside [x_min, x_max]."""
        ...

    def area_to(self, x_mm: Tensor) -> Tensor:
        """The integral of w from x_min to x, closed form, (B, N) -> (B, N) mm^2; constant beyond the ends."""
        ...

    def level(self, a_mm: Tensor) -> tuple[Tensor, Tensor]:
        """The ends (x_left, x_right) of {x : w(x) >= a}, (B, N) -> two (B, N), for a >= 0.

        Above the greatest half width the set is empty and both ends are the place of the peak.
        """
        ...


def column(parameter: Tensor) -> Tensor:
    """A (B,) parameter as (B, 1), to meet a (B, N) grid."""
    return parameter.unsqueeze(-1)


def safe_sqrt(value: Tensor) -> Tensor:
    """The square root of max(value, 0), any shape, with gradient 0 rather than infinity where value <= 0."""
    positive = value > 0
    # Both branches of `where` are differentiated, so the unused one has to be finite as well.
    return torch.where(positive, torch.where(positive, value, torch.ones_like(value)).sqrt(), torch.zeros_like(value))


def disc_integral(u: Tensor) -> Tensor:
    """The integral of sqrt(1 - t^2) from 0 to u, any shape, u in [-1, 1]: (u sqrt(1 - u^2) + asin u) / 2."""
    height = safe_sqrt((1 - u) * (1 + u))
    # atan2 equals asin(u) here, but its gradient stays finite at u = +-1.
    return 0.5 * (u * height + torch.atan2(u, height))
