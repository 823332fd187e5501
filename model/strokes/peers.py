"""CCD-BSM and the simple shapes that it is compared with, each sized by the CCD-BSM mark of the same press.

Ellipse, circle and line are placed on the mark's bounding box, so a score between two models shows a difference of
shape, not a shift. The sources do not define these shapes; each function states the definition chosen and its
alternatives, because scores depend strongly on the choice.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brushloop.model.ccdbsm import CcdBsm, DomainError
from brushloop.model.outline import Array, Outline, closed, evaluate, rounded, safe_sqrt, through
from brushloop.model.strokes import Basis, Profile, StrokeModel

BEZIER_PIECES = 128
"""Parabolas per side of a Bezier stroke: the error is below 1e-6 of a pixel for strokes of the default image."""
QBC_PIECES = 64
"""Parabolas per side of a QBC."""
_CAP_ARCS = 3  # arcs in a round end: each spans less than 120 degrees


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """CCD-BSM, the bounding ellipse of its mark, a circle, a line, and two regressed ones: a Bezier stroke and QBC."""
    sizes, discs, mark = basis.regressed(bezier_sizes), basis.regressed(qbc_sizes), basis.mark
    shapes: dict[str, tuple[str, str, Profile]] = {
        "ccd-bsm": (
            "CCD-BSM",
            f"Half an ellipse at the heel and two parabolas to the tip (Eq. 1-5), widened by lambda = {basis.lam:.4g}.",
            lambda h, a: mark(h, a).outline(),
        ),
        "bezier": (
            "Bezier",
            "Two mirrored cubic Bezier curves; tip, belly, base and shoulder are regressed on (H, alpha) "
            "from CCD-BSM's marks at the paper's 15 conditions.",
            lambda h, a: bezier(**sizes(h, a)),
        ),
        "ellipse": (
            "ellipse",
            "The bounding ellipse of the CCD-BSM mark: same length and width.",
            lambda h, a: bounding_ellipse(mark(h, a)),
        ),
        "circle": (
            "circle",
            "The circle whose diameter is the length of the CCD-BSM mark.",
            lambda h, a: circle(mark(h, a)),
        ),
        "line": (
            "line",
            "The capsule with the length and width of the CCD-BSM mark.",
            lambda h, a: line(mark(h, a)),
        ),
        "qbc": (
            "QBC",
            "A disc of evenly changing width moved along a quadratic Bezier curve; its 8 parameters are "
            "regressed on (H, alpha) from CCD-BSM's marks at the paper's 15 conditions.",
            lambda h, a: qbc(**discs(h, a)),
        ),
    }
    return tuple(StrokeModel(name, *shape, basis.fitted) for name, shape in shapes.items())


def ellipse(centre_mm: Array, semi_x_mm: Array, semi_y_mm: Array) -> Outline:
    """Ellipses with axes along x and y, their centres on the x axis, all (B,) mm."""
    return rounded(centre_mm, semi_x_mm, semi_y_mm, semi_x_mm, semi_y_mm)


def bounding_ellipse(mark: CcdBsm) -> Outline:
    """The bounding ellipse (Wong and Ip): the mark's length and width, centred on its bounding box.

    Alternatives not taken: the ellipse of equal area on the same length (narrower than the mark), and the
    ellipse of equal centroid and second moments.
    """
    return ellipse(mark.middle_mm, 0.5 * mark.length_mm, 0.5 * mark.width_mm)


def circle(mark: CcdBsm) -> Outline:
    """The circle whose diameter is the mark's length, centred on its bounding box.

    Alternatives not taken: the mark's width as the diameter, and the circle of the mark's area.
    """
    return ellipse(mark.middle_mm, 0.5 * mark.length_mm, 0.5 * mark.length_mm)


def line(mark: CcdBsm) -> Outline:
    """The capsule with the mark's length and width, round ends included in the length.

    A mark that is wider than long (a stubby brush) gives a capsule along y. Alternatives not taken: the
    rectangle of that length and width (butt ends), and round ends added beyond the length.
    """
    half_length, half_width = 0.5 * mark.length_mm, 0.5 * mark.width_mm
    radius = np.minimum(half_length, half_width)
    return rounded(mark.middle_mm, half_length, half_width, radius, radius)


def bezier(tip_mm: Array, base_mm: Array, belly_mm: Array, shoulder: Array) -> Outline:
    """Two symmetric cubic Bezier curves from tip to base (Zhang et al.; Wang and Min), all (B,).

    The upper one goes through (-tip, 0), (shoulder, h), (base, h), (base, 0) with h = 2/3 belly. `tip_mm` and `base_mm`
    are the distances of the ends from the origin, `belly_mm` is the greatest width, and `shoulder` from 0 to 1 is where
    the curve's second point stands, as a share of the length.
    """
    tip, base, belly, share = (value[:, None] for value in (tip_mm, base_mm, belly_mm, shoulder))
    t = np.linspace(1, 0, 2 * BEZIER_PIECES + 1)
    second = share * (tip + base) - tip
    x = (1 - t) ** 3 * -tip + 3 * t * (1 - t) ** 2 * second + t**2 * (3 - 2 * t) * base
    y = 2 * belly * t * (1 - t)
    return closed(np.stack((x, y), -1), np.stack((x, -y), -1)[:, ::-1])


def bezier_sizes(mark: CcdBsm) -> dict[str, Any]:
    """Tip, base and belly of a CCD-BSM mark, and the shoulder that gives the Bezier stroke the mark's area.

    For a share s, the enclosed area is belly (tip + base) (4 - s) / 5.
    """
    shoulder = np.clip(4 - 5 * mark.area_mm2 / (mark.width_mm * mark.length_mm), 0, 1)
    return {"tip_mm": mark.o4o3_mm, "base_mm": mark.o3a_mm, "belly_mm": mark.width_mm, "shoulder": shoulder}


def qbc(start_width_mm: Array, end_width_mm: Array, **control_mm: Array) -> Outline:
    """QBC, a disc of changing width moved along a quadratic Bezier curve, 8 parameters (the paper's ablation).

    The control points are `x0_mm`, `y0_mm` to `x2_mm`, `y2_mm`, with a width at either end, all (B,). With centre c(t),
    radius r(t), tangent T, left normal N and k = r' / |c'|, the disc's envelope is c + r (-k T +- sqrt(1 - k^2) N): the
    two sides of the stroke, `QBC_PIECES` parabolas each. The first and the last disc close the outline.

    Raises DomainError if a disc contains its neighbours (the width changes faster than the curve advances) or if a bend
    is tighter than the stroke is thick, so that its inner side folds over. Where a stroke overlaps itself elsewhere,
    `area_mm2` counts the overlap twice and the rasterisers are wrong along its boundary.
    """
    nodes = np.stack([np.stack((control_mm[f"x{k}_mm"], control_mm[f"y{k}_mm"]), -1) for k in range(3)], 1)
    t = np.linspace(0, 1, 2 * QBC_PIECES + 1)
    centre = evaluate(nodes[:, None], np.ones_like(t), t)
    steps = 2 * (nodes[:, 1:] - nodes[:, :-1])
    velocity = (1 - t)[:, None] * steps[:, :1] + t[:, None] * steps[:, 1:]
    speed = safe_sqrt((velocity**2).sum(-1))
    radius = 0.5 * (start_width_mm[:, None] * (1 - t) + end_width_mm[:, None] * t)
    growth = (0.5 * (end_width_mm - start_width_mm))[:, None]
    _check_speed(start_width_mm, end_width_mm, growth, speed)
    along = velocity / speed[..., None]
    left = np.stack((-along[..., 1], along[..., 0]), -1)
    k = growth / speed
    sine = safe_sqrt((1 - k) * (1 + k))
    back, aside = -(radius * k)[..., None] * along, (radius * sine)[..., None] * left
    right_side, left_side = centre + back - aside, centre + back + aside
    _check_folds(right_side, left_side, along, nodes)
    heading = np.arctan2(along[..., 1], along[..., 0])
    lean = np.arctan2(sine, -k)  # angle from the tangent to the envelope's point of contact
    end, end_weights = _cap(centre[:, -1], radius[:, -1], heading[:, -1] - lean[:, -1], 2 * lean[:, -1])
    start, start_weights = _cap(centre[:, 0], radius[:, 0], heading[:, 0] + lean[:, 0], 2 * (math.pi - lean[:, 0]))
    sides = through(right_side), through(left_side[:, ::-1])
    flat = np.ones_like(sides[0][..., 0, 0])
    points = np.concatenate((sides[0], end, sides[1], start), 1)
    return Outline(points, np.concatenate((flat, end_weights, flat, start_weights), 1))


def qbc_sizes(mark: CcdBsm) -> dict[str, Any]:
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
    half = (span / (2 * _CAP_ARCS))[:, None]
    k = np.arange(2 * _CAP_ARCS + 1)
    angle = start[:, None] + k * half
    reach = radius[:, None] * (1 + k % 2 * (1 / np.cos(half) - 1))
    points = centre[:, None] + reach[..., None] * np.stack((np.cos(angle), np.sin(angle)), -1)
    arcs = np.stack((points[:, :-1:2], points[:, 1::2], points[:, 2::2]), 2)
    return arcs, np.cos(half) * np.ones_like(arcs[..., 0, 0])


def _check_speed(start_width_mm: Array, end_width_mm: Array, growth: Array, speed: Array) -> None:
    """Raise DomainError where the width changes too much for the length of the curve."""
    held = (np.abs(growth) >= speed).any(-1)
    if held.any():
        at = int(held.argmax())
        allowed = f"{float(start_width_mm[at]):g} +- {float(2 * speed[at].min()):g} mm"
        raise DomainError(
            "end_width_mm", float(end_width_mm[at]), allowed, "the width changes too much for the length of the curve"
        )


def _check_folds(right: Array, left: Array, along: Array, nodes: Array) -> None:
    """Raise DomainError unless both sides run forward with the curve."""
    tangent = along[:, 1:] + along[:, :-1]
    steps = (np.diff(side, axis=1) for side in (right, left))
    folded = np.any([((step * tangent).sum(-1) < 0).any(-1) for step in steps], axis=0)
    if folded.any():
        at = int(folded.argmax())
        allowed = "a curve whose bends are wider than the stroke is thick"
        raise DomainError("x1_mm", float(nodes[at, 1, 0]), allowed)
