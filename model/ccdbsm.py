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
from typing import Any

import numpy as np

from brushloop.model.outline import Array, Outline, as_batch, safe_sqrt


class DomainError(ValueError):
    """A parameter outside the domain; carries its `name`, the first bad `value` and the `allowed` range."""

    def __init__(self, name: str, value: float, allowed: str, hint: str = "") -> None:
        super().__init__(f"{name} = {value:g} is outside {allowed}" + (f"; {hint}" if hint else ""))
        self.name = name
        self.value = value
        self.allowed = allowed


@dataclass(frozen=True, slots=True)
class Brush:
    """The hair bundle as a cone: largest radius R and length L, mm; both must be positive, else DomainError.

    R and L are floats, or (B,) arrays for a batch of brushes.
    """

    radius_mm: Array = 6.0
    length_mm: Array = 48.0

    def __post_init__(self) -> None:
        _require_positive("radius_mm", self.radius_mm)
        _require_positive("length_mm", self.length_mm)


@dataclass(frozen=True, slots=True, eq=False)
class CcdBsm:
    """A batch of B marks: the basic lengths of Eq. 2-4 in mm and the dilation lambda, all (B,).

    Eq. 1: w = lambda O3C sqrt(1 - x^2 / O3A^2) for 0 <= x <= O3A, and lambda O3C (1 - x^2 / O4O3^2) for
    -O4O3 <= x < 0.
    """

    o3a_mm: Array
    o3c_mm: Array
    o4o3_mm: Array
    lam: Array

    @property
    def x_min_mm(self) -> Array:
        """The tip, -O4O3, (B,)."""
        return -self.o4o3_mm

    @property
    def x_max_mm(self) -> Array:
        """The end of the heel, O3A, (B,)."""
        return self.o3a_mm

    @property
    def middle_mm(self) -> Array:
        """x of the middle between both ends, (B,)."""
        return 0.5 * (self.x_min_mm + self.x_max_mm)

    @property
    def half_width_mm(self) -> Array:
        """The greatest half width, lambda O3C, at x = 0, (B,)."""
        return self.lam * self.o3c_mm

    @property
    def width_mm(self) -> Array:
        """The greatest width, 2 lambda O3C, (B,)."""
        return 2 * self.half_width_mm

    @property
    def length_mm(self) -> Array:
        """The whole length, O3A + O4O3, (B,)."""
        return self.o3a_mm + self.o4o3_mm

    @property
    def area_mm2(self) -> Array:
        """The area enclosed by Eq. 1, lambda O3C (pi/2 O3A + 4/3 O4O3), (B,)."""
        return self.half_width_mm * (0.5 * math.pi * self.o3a_mm + 4 / 3 * self.o4o3_mm)

    def outline(self) -> Outline:
        """Eq. 1 as two quarters of an ellipse and two parabolas, exactly; (B, 4) arcs from the end of the heel."""
        heel, tip, wide = (size[:, None, None] for size in (self.o3a_mm, self.o4o3_mm, self.half_width_mm))
        # Shares of heel, tip and half width. The parabolas' tangents, level at x = 0 and 2 w / O4O3 steep at the tip,
        # meet halfway.
        x = np.array(((1, 1, 0), (0, -0.5, -1), (-1, -0.5, 0), (0, 1, 1)))
        y = np.array(((0, 1, 1), (1, 1, 0), (0, -1, -1), (-1, -1, 0)))
        quarter = math.sqrt(0.5)
        weights = np.ones_like(heel[:, 0]) * (quarter, 1, 1, quarter)
        return Outline(np.stack((np.where(x > 0, heel, tip) * x, wide * y), -1), weights)

    def half_width(self, x_mm: Array) -> Array:
        """Eq. 1 at x, (B, N) -> (B, N) mm; zero outside the mark."""
        heel = np.clip(x_mm / self.o3a_mm[:, None], 0, 1)
        tip = np.clip(x_mm / self.o4o3_mm[:, None], -1, 0)
        # The other side's fraction is clipped to 0, so its factor is 1 and one product covers both sides.
        return self.half_width_mm[:, None] * safe_sqrt((1 - heel) * (1 + heel)) * (1 - tip) * (1 + tip)


def basic_lengths(
    depth_mm: Array, alpha: Array, radius_mm: Array, length_mm: Array, xp: Any
) -> tuple[Array, Array, Array]:
    """O3A, O3C and O4O3 in mm (Eq. 2-5) of presses at alpha in radians, computed by `xp`: numpy or math."""
    theta = xp.atan(radius_mm / length_mm)
    o3a = depth_mm * (xp.tan(alpha) - xp.tan(alpha - theta))
    o3c = depth_mm * (radius_mm / (length_mm * xp.cos(alpha)))
    return o3a, o3c, depth_mm / xp.cos(alpha - theta) + o3a


def ccdbsm(brush: Brush, depth_mm: Array, tilt_deg: Array, lam: Array = math.pi) -> CcdBsm:
    """The CCD-BSM mark (Eq. 1-5) of presses to depth H at tilt alpha; scalars or (B,), broadcast to one (B,).

    lambda = pi preserves the area of each cross-section. Raises DomainError unless alpha >= 0,
    alpha + theta < 90 deg, 0 < H <= L cos alpha, lambda > 0.
    """
    _require_positive("lam", lam)
    depth, tilt, radius, length, dilation = as_batch(depth_mm, tilt_deg, brush.radius_mm, brush.length_mm, lam)
    _check_domain(depth, tilt, radius, length)
    return CcdBsm(*basic_lengths(depth, np.deg2rad(tilt), radius, length, np), dilation)


def _require_positive(name: str, value: Array) -> None:
    """Raise DomainError unless every element is positive and finite."""
    values = np.ravel(value)
    bad = values[~((values > 0) & np.isfinite(values))]
    if len(bad):
        raise DomainError(name, float(bad[0]), "(0, inf)")


def _check_domain(depth: Array, tilt: Array, radius: Array, length: Array) -> None:
    """Raise DomainError for the first press outside the domain; NaN counts as outside."""
    limit_deg = 90 - np.degrees(np.arctan(radius / length))
    bad = ~((tilt >= 0) & (tilt < limit_deg))
    if bad.any():
        first = int(bad.argmax())
        negative = "a negative tilt is |alpha| with the heading + 180 deg"
        hint = negative if tilt[first] < 0 else "alpha + atan(R / L) stays below 90 deg"
        raise DomainError("tilt_deg", float(tilt[first]), f"[0, {float(limit_deg[first]):g}) deg", hint)
    deepest = length * np.cos(np.radians(tilt))
    bad = ~((depth > 0) & (depth <= deepest))
    if bad.any():
        first = int(bad.argmax())
        allowed = f"(0, {float(deepest[first]):g}] mm"
        raise DomainError("depth_mm", float(depth[first]), allowed, "H is at most L cos(alpha)")
