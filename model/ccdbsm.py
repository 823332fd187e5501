"""CCD-BSM, the composite-curve-dilation brush stroke model: the mark of one press in closed form.

A cone of radius R and length L is pressed to depth H at tilt alpha. The paper plane cuts the cone; half of
that section and two parabolas that meet at the tip form the basic graphic, which is dilated across its axis
by lambda (Eq. 1).

    O3A    = H (tan alpha - tan(alpha - theta))         (Eq. 2)
    O3C    = H R / (L cos alpha)                        (Eq. 3)
    O4O3   = H / cos(alpha - theta) + O3A               (Eq. 4)
    theta  = atan(R / L)                                (Eq. 5)

The paper writes Eq. 2 and 4 with H / tan(90 deg - alpha); the tangent form is the same number without a
division by an infinite tangent at alpha = 0. O3A is the distance from the brush axis to the tip-side wall of
the cone, although Eq. 1 draws it on the heel side; this is kept as published.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from brushloop.model.brush import Brush, DomainError, require_positive
from brushloop.model.outline import Outline, loop, safe_sqrt


@dataclass(frozen=True, slots=True, eq=False)
class CcdBsm:
    """A batch of B marks: the basic lengths of Eq. 2-4 in mm and the dilation lambda, all (B,).

    Eq. 1: w = lambda O3C sqrt(1 - x^2 / O3A^2) for 0 <= x <= O3A, and lambda O3C (1 - x^2 / O4O3^2) for
    -O4O3 <= x < 0.
    """

    o3a_mm: Tensor
    o3c_mm: Tensor
    o4o3_mm: Tensor
    lam: Tensor

    @property
    def x_min_mm(self) -> Tensor:
        """The tip, -O4O3, (B,)."""
        return -self.o4o3_mm

    @property
    def x_max_mm(self) -> Tensor:
        """The end of the heel, O3A, (B,)."""
        return self.o3a_mm

    @property
    def half_width_mm(self) -> Tensor:
        """The greatest half width, lambda O3C, at x = 0, (B,)."""
        return self.lam * self.o3c_mm

    @property
    def width_mm(self) -> Tensor:
        """The greatest width, 2 lambda O3C, (B,)."""
        return 2 * self.half_width_mm

    @property
    def length_mm(self) -> Tensor:
        """The whole length, O3A + O4O3, (B,)."""
        return self.o3a_mm + self.o4o3_mm

    @property
    def area_mm2(self) -> Tensor:
        """The area enclosed by Eq. 1, lambda O3C (pi/2 O3A + 4/3 O4O3), (B,)."""
        return self.half_width_mm * (0.5 * math.pi * self.o3a_mm + 4 / 3 * self.o4o3_mm)

    def outline(self) -> Outline:
        """Eq. 1 as two quarters of an ellipse and two parabolas, exactly."""
        a, t, w = self.o3a_mm, self.o4o3_mm, self.half_width_mm
        o = torch.zeros_like(a)
        # The parabola's tangents, level at x = 0 and 2 w / t steep at the tip, meet halfway.
        return loop(
            ((a, o, a, w, o, w), math.sqrt(0.5)),
            ((o, w, -0.5 * t, w, -t, o), 1.0),
            ((-t, o, -0.5 * t, -w, o, -w), 1.0),
            ((o, -w, a, -w, a, o), math.sqrt(0.5)),
        )

    def half_width(self, x_mm: Tensor) -> Tensor:
        """Eq. 1 at x, (B, N) -> (B, N) mm; zero outside the mark."""
        heel = (x_mm / self.o3a_mm[:, None]).clamp(0, 1)
        tip = (x_mm / self.o4o3_mm[:, None]).clamp(-1, 0)
        # The other side's fraction is clamped to 0, so its factor is 1 and one product covers both sides.
        return self.half_width_mm[:, None] * safe_sqrt((1 - heel) * (1 + heel)) * (1 - tip) * (1 + tip)


def ccdbsm(
    brush: Brush,
    depth_mm: float | Tensor,
    tilt_deg: float | Tensor,
    lam: float | Tensor = math.pi,
    *,
    dtype: torch.dtype | None = None,
) -> CcdBsm:
    """The CCD-BSM mark (Eq. 1-5) of presses to depth H at tilt alpha; scalars or (B,) tensors, broadcast to
    one (B,).

    The dtype is `dtype`, else that of the floating-point arguments, else float64. lambda = pi preserves the
    area of each cross-section. Raises DomainError unless alpha >= 0, alpha + theta < 90 deg, 0 < H <= L cos
    alpha, lambda > 0.
    """
    require_positive("lam", lam)
    height, tilt, radius, length, dilation = as_batch(
        depth_mm, tilt_deg, brush.radius_mm, brush.length_mm, lam, dtype=dtype
    )
    alpha = torch.deg2rad(tilt)
    theta = torch.atan(radius / length)
    _check_domain(height.detach(), tilt.detach(), theta.detach(), length.detach())
    o3a = height * (torch.tan(alpha) - torch.tan(alpha - theta))
    o3c = height * radius / (length * torch.cos(alpha))
    o4o3 = height / torch.cos(alpha - theta) + o3a
    return CcdBsm(o3a_mm=o3a, o3c_mm=o3c, o4o3_mm=o4o3, lam=dilation)


def as_batch(*values: float | Tensor, dtype: torch.dtype | None = None) -> tuple[Tensor, ...]:
    """All values as (B,) tensors of one floating dtype on the device of the first tensor.

    The dtype is `dtype`, else that of the floating-point arguments, else float64. Raises ValueError for a
    tensor of two or more dimensions.
    """
    tensors = [value for value in values if isinstance(value, Tensor)]
    if dtype is None:
        floating = [tensor.dtype for tensor in tensors if tensor.is_floating_point()]
        dtype = floating[0] if floating else torch.float64
        for other in floating[1:]:
            dtype = torch.promote_types(dtype, other)
    device = tensors[0].device if tensors else None
    batch = [torch.as_tensor(value, dtype=dtype, device=device) for value in values]
    if any(tensor.ndim > 1 for tensor in batch):
        raise ValueError(f"stroke parameters are scalars or (B,), got shapes {[tuple(t.shape) for t in batch]}")
    return torch.broadcast_tensors(*(torch.atleast_1d(tensor) for tensor in batch))


def _check_domain(height: Tensor, tilt: Tensor, theta: Tensor, length: Tensor) -> None:
    """Raise DomainError for the first press outside the domain; NaN counts as outside."""
    limit_deg = 90 - torch.rad2deg(theta)
    bad = ~((tilt >= 0) & (tilt < limit_deg))
    if bad.any():
        index = int(bad.nonzero()[0])
        negative = "a negative tilt is |alpha| with the heading + 180 deg"
        hint = negative if tilt[index] < 0 else "alpha + atan(R / L) stays below 90 deg"
        raise DomainError("tilt_deg", float(tilt[index]), f"[0, {float(limit_deg[index]):g}) deg", hint)
    deepest = length * torch.cos(torch.deg2rad(tilt))
    bad = ~((height > 0) & (height <= deepest))
    if bad.any():
        index = int(bad.nonzero()[0])
        allowed = f"(0, {float(deepest[index]):g}] mm"
        raise DomainError("depth_mm", float(height[index]), allowed, "H is at most L cos(alpha)")
