"""Two symmetric cubic Bezier curves from tip to base (Zhang et al.; Wang and Min), regressed on (H, alpha)."""

from __future__ import annotations

import torch

from brushloop.model.ccdbsm import CcdBsm
from brushloop.model.loops import BEZIER_PIECES, bezier_side
from brushloop.model.outline import Outline, through
from brushloop.model.protocol import Basis, ParameterSpec, Parametric, StrokeModel, Values
from brushloop.model.regression import regressed

PARAMETERS = (
    ParameterSpec("tip_mm", "mm", 0.001, 400, 17, "from the origin to the end of the tip"),
    ParameterSpec("base_mm", "mm", 0.001, 400, 2, "from the origin to the end of the base"),
    ParameterSpec("belly_mm", "mm", 0.001, 400, 12, "the greatest width"),
    ParameterSpec("shoulder", "1", 0, 1, 0.6, "where the curve's second point stands, as a share of the length"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The Bezier stroke regressed on CCD-BSM's marks at the paper's cells, not on captures."""
    return (
        Parametric(
            name="bezier",
            label="Bezier",
            definition="Two mirrored cubic Bezier curves; tip, belly, base and shoulder are regressed on (H, alpha) "
            "from CCD-BSM's marks at the paper's 15 cells.",
            parameters=PARAMETERS,
            build=bezier,
            press=regressed(basis, lengths),
            fitted=basis.fitted,
        ),
    )


def bezier(values: Values) -> Outline:
    """The outline through (-tip, 0), (shoulder, h), (base, h), (base, 0) and its mirror image; h = 2/3 belly."""
    tip = values["tip_mm"]
    t = torch.linspace(1, 0, 2 * BEZIER_PIECES + 1, dtype=tip.dtype, device=tip.device)
    upper = torch.stack(bezier_side(t, *(values[spec.name][:, None] for spec in PARAMETERS)), dim=-1)
    points = torch.cat((through(upper), through(upper.flip(1) * upper.new_tensor([1, -1]))), dim=1)
    return Outline(points, torch.ones_like(points[..., 0, 0]))


def lengths(mark: CcdBsm) -> Values:
    """Tip, base and belly of a CCD-BSM mark, and the shoulder that gives the Bezier stroke the mark's area.

    For a share s, the enclosed area is belly (tip + base) (4 - s) / 5.
    """
    shoulder = 4 - 5 * mark.area_mm2 / (mark.width_mm * mark.length_mm)
    return {"tip_mm": mark.o4o3_mm, "base_mm": mark.o3a_mm, "belly_mm": mark.width_mm, "shoulder": shoulder.clamp(0, 1)}
