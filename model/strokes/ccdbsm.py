"""CCD-BSM, the model of the paper: see `model.ccdbsm`."""

from __future__ import annotations

import math

from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import as_batch, ccdbsm
from brushloop.model.protocol import Basis, Number, ParameterSpec, Parametric, StrokeModel, Values

PARAMETERS = (
    ParameterSpec("depth_mm", "mm", 0.01, 200, 15, "H, how far the tip is pressed below the paper"),
    ParameterSpec("tilt_deg", "deg", 0, 89.9, 5, "alpha, the brush axis from the vertical"),
    ParameterSpec("radius_mm", "mm", 0.1, 100, 6, "R, the largest radius of the bundle"),
    ParameterSpec("length_mm", "mm", 1, 400, 48, "L, the length of the bundle"),
    ParameterSpec("lam", "1", 0.1, 10, math.pi, "lambda, the dilation across the axis; pi keeps areas"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """CCD-BSM with the basis' brush and lambda."""

    def press(depth_mm: Number, tilt_deg: Number) -> Values:
        basis.mark(depth_mm, tilt_deg)  # checks the exact domain; its DomainError carries a hint
        batch = as_batch(depth_mm, tilt_deg, basis.brush.radius_mm, basis.brush.length_mm, basis.lam)
        return {spec.name: value for spec, value in zip(PARAMETERS, batch, strict=True)}

    return (
        Parametric(
            name="ccd-bsm",
            label="CCD-BSM",
            definition=f"Half an ellipse at the heel and two parabolas to the tip (Eq. 1-5), dilation {basis.lam:.4g}.",
            parameters=PARAMETERS,
            build=lambda v: ccdbsm(Brush(v["radius_mm"], v["length_mm"]), v["depth_mm"], v["tilt_deg"], v["lam"]),
            press=press,
            fitted=basis.fitted,
        ),
    )
