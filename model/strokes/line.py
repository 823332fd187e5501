"""Straight strokes with round ends: of one width (a capsule), and tapered toward the tip."""

from __future__ import annotations

import torch

from brushloop.model import baselines
from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.outline import Outline
from brushloop.model.protocol import Basis, Number, ParameterSpec, Parametric, StrokeModel, Values
from brushloop.model.regression import regressed, solve
from brushloop.model.sweep import swept

CAPSULE = (
    ParameterSpec("centre_mm", "mm", -200, 200, -10, "x of the middle, on the stroke axis"),
    ParameterSpec("radius_mm", "mm", 0.001, 400, 6, "radius of the round ends"),
    ParameterSpec("reach_x_mm", "mm", 0, 400, 6, "half the straight part along the axis"),
    ParameterSpec("reach_y_mm", "mm", 0, 400, 0, "half the straight part across it, for marks wider than long"),
)
TAPERED = (
    ParameterSpec("tip_mm", "mm", -400, 400, -20, "x of the centre of the small end"),
    ParameterSpec("heel_mm", "mm", -400, 400, -4, "x of the centre of the large end"),
    ParameterSpec("tip_width_mm", "mm", 0.001, 400, 4, "width of the small end"),
    ParameterSpec("heel_width_mm", "mm", 0.001, 400, 12, "width of the large end"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The capsule and the tapered line, with the CCD-BSM mark's length and width."""
    capsule = "The capsule with the length and width of the CCD-BSM mark."
    tapered = "The hull of two discs with the CCD-BSM mark's length, width and area, regressed as Bezier is."
    press = regressed(basis, discs)

    def line(h: Number, a: Number) -> Values:
        shape = baselines.line(basis.mark(h, a))
        return {spec.name: getattr(shape, spec.name) for spec in CAPSULE}

    return (
        Parametric("line", "line", capsule, CAPSULE, lambda v: baselines.Capsule(**v), line, basis.fitted),
        Parametric("line-tapered", "tapered line", tapered, TAPERED, hull, press, basis.fitted),
    )


def hull(values: Values) -> Outline:
    """The convex hull of two discs on the axis; DomainError if one contains the other."""
    tip, heel = values["tip_mm"], values["heel_mm"]
    x = torch.stack((tip, 0.5 * (tip + heel), heel), dim=-1)
    return swept(torch.stack((x, torch.zeros_like(x)), dim=-1), values["tip_width_mm"], values["heel_width_mm"], 1)


def discs(mark: CcdBsm) -> Values:
    """The two discs of a mark: the heel as wide as the mark, the tip sized so that the areas agree."""
    heel = torch.minimum(mark.half_width_mm, 0.45 * mark.length_mm)

    def values(tip: torch.Tensor) -> Values:
        sizes = (mark.x_min_mm + tip, mark.x_max_mm - heel, 2 * tip, 2 * heel)
        return {spec.name: size for spec, size in zip(TAPERED, sizes, strict=True)}

    return values(solve(lambda tip: hull(values(tip)).area_mm2, mark.area_mm2, 0.01 * heel, heel))
