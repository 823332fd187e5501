"""QBC: a disc of changing width moved along a quadratic Bezier curve, 8 parameters (the paper's ablation)."""

from __future__ import annotations

import torch

from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.outline import Outline
from brushloop.model.protocol import Basis, ParameterSpec, Parametric, StrokeModel, Values
from brushloop.model.regression import regressed, solve
from brushloop.model.sweep import swept

NODES = (("x0_mm", -17), ("y0_mm", 0), ("x1_mm", -10), ("y1_mm", 0), ("x2_mm", -4), ("y2_mm", 0))
PARAMETERS = (
    *(ParameterSpec(name, "mm", -400, 400, at, f"{name[0]} of control point {name[1]} of 0-2") for name, at in NODES),
    ParameterSpec("start_width_mm", "mm", 0.001, 400, 1, "the stroke's width at the first control point"),
    ParameterSpec("end_width_mm", "mm", 0.001, 400, 10, "the stroke's width at the last control point"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """QBC regressed on CCD-BSM's marks at the paper's cells, not on captures."""
    return (
        Parametric(
            name="qbc",
            label="QBC",
            definition="A disc of evenly changing width moved along a quadratic Bezier curve; its 8 parameters are "
            "regressed on (H, alpha) from CCD-BSM's marks at the paper's 15 cells.",
            parameters=PARAMETERS,
            build=qbc,
            press=regressed(basis, straight),
            fitted=basis.fitted,
        ),
    )


def qbc(v: Values) -> Outline:
    """The outline of the swept disc; DomainError if it folds over."""
    nodes = torch.stack([torch.stack((v[f"x{k}_mm"], v[f"y{k}_mm"]), dim=-1) for k in range(3)], dim=1)
    return swept(nodes, v["start_width_mm"], v["end_width_mm"])


def straight(mark: CcdBsm) -> Values:
    """The straight QBC with a mark's length and width; its middle point is chosen so that the areas agree best."""
    end = torch.minimum(mark.half_width_mm, 0.36 * mark.length_mm)  # a wider disc would contain the first one
    start, o = 0.05 * end, torch.zeros_like(end)
    first, last = mark.x_min_mm + start, mark.x_max_mm - end
    most = 1 - 0.525 * (end - start) / (last - first)  # the curve advances faster than the width changes at both ends

    def values(share: torch.Tensor) -> Values:
        middle = last + share * (first - last)
        named = {"x0_mm": first, "y0_mm": o, "x1_mm": middle, "y1_mm": o, "x2_mm": last, "y2_mm": o}
        return {**named, "start_width_mm": 2 * start, "end_width_mm": 2 * end}

    return values(solve(lambda share: qbc(values(share)).area_mm2, mark.area_mm2, 1 - most, most))
