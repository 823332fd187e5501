"""The circle, sized by the CCD-BSM mark: see `model.baselines.circle`, which also offers other diameters."""

from __future__ import annotations

from model import baselines
from model.protocol import Basis, Number, ParameterSpec, Parametric, StrokeModel, Values

PARAMETERS = (
    ParameterSpec("centre_mm", "mm", -200, 200, -10, "x of the centre, on the stroke axis"),
    ParameterSpec("radius_mm", "mm", 0.001, 400, 12, "the radius"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The circle over the length of the CCD-BSM mark."""

    def press(height_mm: Number, tilt_deg: Number) -> Values:
        shape = baselines.circle(basis.mark(height_mm, tilt_deg))
        return {"centre_mm": shape.centre_mm, "radius_mm": shape.semi_x_mm}

    return (
        Parametric(
            name="circle",
            label="circle",
            definition="The circle whose diameter is the length of the CCD-BSM mark.",
            parameters=PARAMETERS,
            build=lambda v: baselines.Ellipse(v["centre_mm"], v["radius_mm"], v["radius_mm"]),
            press=press,
            fitted=basis.fitted,
        ),
    )
