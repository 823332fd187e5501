"""QBC: a disc of changing width moved along a quadratic Bezier curve, 8 parameters (the paper's ablation).

With centre c(t), radius r(t), tangent T, left normal N and k = r' / |c'|, the disc's envelope is
c + r (-k T +- sqrt(1 - k^2) N): the two sides of the stroke. The first and the last disc close the outline.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brushloop.model.arrays import Array, as_numpy, library, like, safe_sqrt
from brushloop.model.ccdbsm import CcdBsm, DomainError
from brushloop.model.outline import Outline, evaluate, through
from brushloop.model.strokes import Basis, StrokeModel

PIECES = 64
"""Parabolas per side."""
_CAP_ARCS = 3  # arcs in a round end: each spans less than 120 degrees


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """QBC regressed on CCD-BSM's marks at the paper's cells, not on captures."""
    parameters = basis.regressed(straight)
    definition = "A disc of evenly changing width moved along a quadratic Bezier curve; its 8 parameters are "
    definition += "regressed on (H, alpha) from CCD-BSM's marks at the paper's 15 cells."
    return (StrokeModel("qbc", "QBC", definition, lambda h, a: qbc(**parameters(h, a)), basis.fitted),)


def qbc(start_width_mm: Array, end_width_mm: Array, **control_mm: Array) -> Outline:
    """The swept disc with control points `x0_mm`, `y0_mm` to `x2_mm`, `y2_mm` and a width at either end, all (B,).

    `PIECES` parabolas per side and round ends. Raises DomainError if a disc contains its neighbours (the width changes
    faster than the curve advances) or if a bend is tighter than the stroke is thick, so that its inner side folds over.
    Where a stroke overlaps itself elsewhere, `area_mm2` counts the overlap twice and the rasterisers are wrong along
    its boundary.
    """
    xp = library(start_width_mm, *control_mm.values())
    nodes = xp.stack([xp.stack((control_mm[f"x{k}_mm"], control_mm[f"y{k}_mm"]), -1) for k in range(3)], 1)
    t = like(np.linspace(0, 1, 2 * PIECES + 1), nodes)
    centre = evaluate(nodes[:, None], xp.ones_like(t), t)
    steps = 2 * (nodes[:, 1:] - nodes[:, :-1])
    velocity = (1 - t)[:, None] * steps[:, :1] + t[:, None] * steps[:, 1:]
    speed = safe_sqrt((velocity**2).sum(-1))
    radius = 0.5 * (start_width_mm[:, None] * (1 - t) + end_width_mm[:, None] * t)
    growth = (0.5 * (end_width_mm - start_width_mm))[:, None]
    _check_speed(start_width_mm, end_width_mm, growth, speed)
    along = velocity / speed[..., None]
    left = xp.stack((-along[..., 1], along[..., 0]), -1)
    k = growth / speed
    sine = safe_sqrt((1 - k) * (1 + k))
    back, aside = -(radius * k)[..., None] * along, (radius * sine)[..., None] * left
    right_side, left_side = centre + back - aside, centre + back + aside
    _check_folds(right_side, left_side, along, nodes)
    heading = xp.arctan2(along[..., 1], along[..., 0])
    lean = xp.arctan2(sine, -k)  # angle from the tangent to the envelope's point of contact
    end, end_weights = _cap(centre[:, -1], radius[:, -1], heading[:, -1] - lean[:, -1], 2 * lean[:, -1])
    start, start_weights = _cap(centre[:, 0], radius[:, 0], heading[:, 0] + lean[:, 0], 2 * (math.pi - lean[:, 0]))
    sides = through(right_side), through(xp.flip(left_side, (1,)))
    flat = xp.ones_like(sides[0][..., 0, 0])
    points = xp.concat((sides[0], end, sides[1], start), 1)
    return Outline(points, xp.concat((flat, end_weights, flat, start_weights), 1))


def straight(mark: CcdBsm) -> dict[str, Any]:
    """The straight QBC with a mark's length and width; its middle point is chosen so that the areas agree best."""
    end = np.minimum(mark.half_width_mm, 0.36 * mark.length_mm)  # a wider disc would contain the first one
    start, o = 0.05 * end, np.zeros_like(end)
    first, last = mark.x_min_mm + start, mark.x_max_mm - end
    most = 1 - 0.525 * (end - start) / (last - first)  # the curve advances faster than the width changes at both ends

    def parameters(share: Array) -> dict[str, Any]:
        middle = last + share * (first - last)
        named = {"x0_mm": first, "y0_mm": o, "x1_mm": middle, "y1_mm": o, "x2_mm": last, "y2_mm": o}
        return {**named, "start_width_mm": 2 * start, "end_width_mm": 2 * end}

    low, high = 1 - most, most
    for _ in range(50):  # the area grows with the share: bisection, of all marks at once
        middle = 0.5 * (low + high)
        below = qbc(**parameters(middle)).area_mm2 < mark.area_mm2
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return parameters(0.5 * (low + high))


def _cap(centre: Array, radius: Array, start: Array, span: Array) -> tuple[Array, Array]:
    """A circular arc from the angle `start` over `span`, all (B,): points (B, n, 3, 2) and weights (B, n)."""
    xp = library(centre)
    half = (span / (2 * _CAP_ARCS))[:, None]
    k = np.arange(2 * _CAP_ARCS + 1)
    angle = start[:, None] + like(k, centre) * half
    corners = like(k % 2, centre)
    reach = radius[:, None] * (1 + corners * (1 / xp.cos(half) - 1))
    points = centre[:, None] + reach[..., None] * xp.stack((xp.cos(angle), xp.sin(angle)), -1)
    arcs = xp.stack((points[:, :-1:2], points[:, 1::2], points[:, 2::2]), 2)
    return arcs, xp.cos(half) * xp.ones_like(arcs[..., 0, 0])


def _check_speed(start_width_mm: Array, end_width_mm: Array, growth: Array, speed: Array) -> None:
    """Raise DomainError where the width changes faster than the curve runs."""
    held = (np.abs(as_numpy(growth)) >= as_numpy(speed)).any(-1)
    if held.any():
        at = int(held.argmax())
        allowed = f"{float(start_width_mm[at]):g} +- {float(2 * speed[at].min()):g} mm"
        raise DomainError(
            "end_width_mm", float(end_width_mm[at]), allowed, "the width changes faster than the curve runs"
        )


def _check_folds(right: Array, left: Array, along: Array, nodes: Array) -> None:
    """Raise DomainError unless both sides run forward with the curve."""
    tangent = as_numpy(along[:, 1:] + along[:, :-1])
    steps = (np.diff(as_numpy(side), axis=1) for side in (right, left))
    folded = np.any([((step * tangent).sum(-1) < 0).any(-1) for step in steps], axis=0)
    if folded.any():
        at = int(folded.argmax())
        allowed = "a curve whose bends are wider than the stroke is thick"
        raise DomainError("x1_mm", float(nodes[at, 1, 0]), allowed)
