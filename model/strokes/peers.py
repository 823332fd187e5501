"""CCD-BSM and the simple shapes that it is compared with, each sized by the CCD-BSM mark of the same press.

Ellipse, circle and line are placed on the mark's bounding box, so a score between two models shows a difference of
shape, not a shift. The sources do not define these shapes; each function states the definition chosen and its
alternatives, because scores depend strongly on the choice.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from brushloop.model.arrays import Array, library, like
from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.outline import Outline, closed, rounded
from brushloop.model.strokes import Basis, Profile, StrokeModel

BEZIER_PIECES = 128
"""Parabolas per side of a Bezier stroke: the error is below 1e-6 of a pixel for strokes of the default image."""


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """CCD-BSM, the bounding ellipse of its mark, a circle, a line, and a Bezier stroke regressed on its marks."""
    sizes, mark = basis.regressed(bezier_sizes), basis.mark
    shapes: dict[str, tuple[str, str, Profile]] = {
        "ccd-bsm": (
            "CCD-BSM",
            f"Half an ellipse at the heel and two parabolas to the tip (Eq. 1-5), dilation {basis.lam:.4g}.",
            lambda h, a: mark(h, a).outline(),
        ),
        "bezier": (
            "Bezier",
            "Two mirrored cubic Bezier curves; tip, belly, base and shoulder are regressed on (H, alpha) "
            "from CCD-BSM's marks at the paper's 15 cells.",
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
    radius = library(half_length).minimum(half_length, half_width)
    return rounded(mark.middle_mm, half_length, half_width, radius, radius)


def bezier(tip_mm: Array, base_mm: Array, belly_mm: Array, shoulder: Array) -> Outline:
    """Two symmetric cubic Bezier curves from tip to base (Zhang et al.; Wang and Min), all (B,).

    The upper one goes through (-tip, 0), (shoulder, h), (base, h), (base, 0) with h = 2/3 belly. `tip_mm` and `base_mm`
    are the distances of the ends from the origin, `belly_mm` is the greatest width, and `shoulder` from 0 to 1 is where
    the curve's second point stands, as a share of the length.
    """
    xp = library(tip_mm)
    tip, base, belly, share = (value[:, None] for value in (tip_mm, base_mm, belly_mm, shoulder))
    t = like(np.linspace(1, 0, 2 * BEZIER_PIECES + 1), tip)
    second = share * (tip + base) - tip
    x = (1 - t) ** 3 * -tip + 3 * t * (1 - t) ** 2 * second + t**2 * (3 - 2 * t) * base
    y = 2 * belly * t * (1 - t)
    return closed(xp.stack((x, y), -1), xp.flip(xp.stack((x, -y), -1), (1,)))


def bezier_sizes(mark: CcdBsm) -> dict[str, Any]:
    """Tip, base and belly of a CCD-BSM mark, and the shoulder that gives the Bezier stroke the mark's area.

    For a share s, the enclosed area is belly (tip + base) (4 - s) / 5.
    """
    shoulder = np.clip(4 - 5 * mark.area_mm2 / (mark.width_mm * mark.length_mm), 0, 1)
    return {"tip_mm": mark.o4o3_mm, "base_mm": mark.o3a_mm, "belly_mm": mark.width_mm, "shoulder": shoulder}
