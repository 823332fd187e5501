"""The ellipse of Wong and Ip, sized by the CCD-BSM mark: see `model.baselines.ellipse`."""

from __future__ import annotations

from model import baselines
from model.protocol import Basis, Number, ParameterSpec, Parametric, StrokeModel, Values

PARAMETERS = (
    ParameterSpec("centre_mm", "mm", -200, 200, -10, "x of the centre, on the stroke axis"),
    ParameterSpec("semi_x_mm", "mm", 0.001, 400, 12, "half the length"),
    ParameterSpec("semi_y_mm", "mm", 0.001, 400, 6, "half the width"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The bounding ellipse of the CCD-BSM mark."""

    def press(height_mm: Number, tilt_deg: Number) -> Values:
        shape = baselines.ellipse(basis.mark(height_mm, tilt_deg))
        return {"centre_mm": shape.centre_mm, "semi_x_mm": shape.semi_x_mm, "semi_y_mm": shape.semi_y_mm}

    return (
        Parametric(
            name="ellipse",
            label="ellipse",
            definition="The bounding ellipse of the CCD-BSM mark: same length and width.",
            parameters=PARAMETERS,
            build=lambda values: baselines.Ellipse(**values),
            press=press,
            fitted=basis.fitted,
        ),
    )
