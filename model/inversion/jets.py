"""Outlines of presses with their derivatives in H and alpha: in closed form for CCD-BSM, by forward mode for any model.

A jet holds the control points of B outlines in the stroke frame, mm, and their derivatives per mm and per degree.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from brushloop.model.outline import Outline
from brushloop.model.protocol import StrokeModel

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Jet:
    """points (B, K, 3, 2), weights (B, K), and d/dH, d/dalpha of both: (B, 2, K, 3, 2) and (B, 2, K)."""

    points: Floats
    weights: Floats
    velocities: Floats
    rates: Floats


_STEP_MM, _STEP_DEG = 1e-4, 1e-3
Jets = Callable[[Floats, Floats], Jet]
"""(H mm, alpha deg), both (B,), to a jet; may raise DomainError."""


def analytic(radius_mm: float, length_mm: float, lam: float) -> Jets:
    """CCD-BSM's jets in closed form: every length is proportional to H, and Eq. 2-4 are differentiated in alpha."""
    theta = math.atan(radius_mm / length_mm)
    quarter = math.sqrt(0.5)

    def jet(depth_mm: Floats, tilt_deg: Floats) -> Jet:
        alpha = np.radians(tilt_deg)
        turn = math.pi / 180
        tangent, less = np.tan(alpha), np.tan(alpha - theta)
        secant, inner = 1 / np.cos(alpha), 1 / np.cos(alpha - theta)
        heel = tangent - less
        d_heel = turn * (secant * secant - inner * inner)
        tip, d_tip = inner + heel, turn * inner * less + d_heel
        wide = lam * radius_mm / length_mm * secant
        d_wide = turn * wide * tangent
        # Unit lengths (B, 3) of heel, half width and tip, and their derivatives.
        unit = np.stack((heel, wide, tip), axis=-1)
        d_unit = np.stack((d_heel, d_wide, d_tip), axis=-1)
        lengths = np.stack((depth_mm[:, None] * unit, unit, depth_mm[:, None] * d_unit), axis=1)
        spread = (lengths @ _SPREAD).reshape(len(lengths), 3, 4, 3, 2)
        weights = np.empty((len(lengths), 4))
        weights[:] = (quarter, 1.0, 1.0, quarter)
        return Jet(spread[:, 0], weights, spread[:, 1:], np.zeros((len(lengths), 2, 4)))

    return jet


def _spread() -> Floats:
    """The map from (heel, half width, tip) to the outline's control points, (3, 24), as `CcdBsm.outline` has them."""
    a, w, t = np.eye(3)
    o = np.zeros(3)
    arcs = (
        ((a, o), (a, w), (o, w)),
        ((o, w), (-0.5 * t, w), (-t, o)),
        ((-t, o), (-0.5 * t, -w), (o, -w)),
        ((o, -w), (a, -w), (a, o)),
    )
    return np.ascontiguousarray(np.array(arcs).reshape(24, 3).T)


_SPREAD = _spread()


def of_model(model: StrokeModel) -> Jets:
    """The jets of any stroke model, by forward-mode differentiation of its outlines.

    A model whose outlines carry no gradient, such as a fitted brush in numpy, uses finite differences instead.
    """

    def outline(height: Tensor, tilt: Tensor) -> Outline:
        return model.profile(height, tilt).outline()

    def jet(depth_mm: Floats, tilt_deg: Floats) -> Jet:
        count = len(depth_mm)
        # Both derivatives in one pass: the batch is repeated, and each half has a different tangent.
        height, tilt = (torch.from_numpy(np.tile(part, 2)) for part in (depth_mm, tilt_deg))
        along_h = torch.cat((torch.ones(count), torch.zeros(count))).double()
        with torch.no_grad(), forward_ad.dual_level():
            made = outline(forward_ad.make_dual(height, along_h), forward_ad.make_dual(tilt, 1 - along_h))
            if forward_ad.unpack_dual(made.points).tangent is None:
                return _differenced(outline, depth_mm, tilt_deg)
            points, velocities = _unpacked(made.points, count)
            weights, rates = _unpacked(made.weights, count)
        return Jet(points, weights, velocities, rates)

    return jet


def _differenced(outline: Callable[[Tensor, Tensor], Outline], depth_mm: Floats, tilt_deg: Floats) -> Jet:
    """A jet by finite differences: central in H, forward in alpha, which is never negative."""
    zero = np.zeros_like(depth_mm)
    at = [(zero, zero), (zero + _STEP_MM, zero), (zero - _STEP_MM, zero), (zero, zero + _STEP_DEG)]
    made = [outline(torch.from_numpy(depth_mm + dh), torch.from_numpy(tilt_deg + da)) for dh, da in at]
    points, weights = ([part.double().numpy() for part in parts] for parts in
                       ([o.points for o in made], [o.weights for o in made]))  # fmt: skip

    def slopes(values: list[Floats]) -> Floats:
        here, up, down, tilted = values
        return np.ascontiguousarray(np.stack(((up - down) / (2 * _STEP_MM), (tilted - here) / _STEP_DEG), axis=1))

    return Jet(np.ascontiguousarray(points[0]), np.ascontiguousarray(weights[0]), slopes(points), slopes(weights))


def _unpacked(dual: Tensor, count: int) -> tuple[Floats, Floats]:
    """Values (B, ...) and tangents (B, 2, ...) of a doubled batch."""
    primal, tangent = cast("tuple[Tensor, Tensor | None]", cast("Any", forward_ad.unpack_dual(dual)))
    moved = torch.zeros_like(primal) if tangent is None else tangent
    both = torch.stack((moved[:count], moved[count:]), dim=1)
    return np.ascontiguousarray(primal[:count].double().numpy()), np.ascontiguousarray(both.double().numpy())
