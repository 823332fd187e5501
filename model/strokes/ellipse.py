"""The ellipse of Wong and Ip and the circle, each sized by the CCD-BSM mark: see `model.baselines`."""

from __future__ import annotations

from brushloop.model import baselines
from brushloop.model.protocol import Basis, Number, ParameterSpec, Parametric, StrokeModel, Values

CENTRE = ParameterSpec("centre_mm", "mm", -200, 200, -10, "x of the centre, on the stroke axis")
ELLIPSE = (
    CENTRE,
    ParameterSpec("semi_x_mm", "mm", 0.001, 400, 12, "half the length"),
    ParameterSpec("semi_y_mm", "mm", 0.001, 400, 6, "half the width"),
)
CIRCLE = (CENTRE, ParameterSpec("radius_mm", "mm", 0.001, 400, 12, "the radius"))


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The bounding ellipse of the CCD-BSM mark, and the circle over its length."""

    def press(depth_mm: Number, tilt_deg: Number) -> Values:
        shape = baselines.ellipse(basis.mark(depth_mm, tilt_deg))
        return {"centre_mm": shape.centre_mm, "semi_x_mm": shape.semi_x_mm, "semi_y_mm": shape.semi_y_mm}

    def press_circle(depth_mm: Number, tilt_deg: Number) -> Values:
        shape = baselines.circle(basis.mark(depth_mm, tilt_deg))
        return {"centre_mm": shape.centre_mm, "radius_mm": shape.semi_x_mm}

    def build_circle(values: Values) -> baselines.Ellipse:
        return baselines.Ellipse(values["centre_mm"], values["radius_mm"], values["radius_mm"])

    bounding = "The bounding ellipse of the CCD-BSM mark: same length and width."
    of_circle = "The circle whose diameter is the length of the CCD-BSM mark."
    return (
        Parametric("ellipse", "ellipse", bounding, ELLIPSE, lambda v: baselines.Ellipse(**v), press, basis.fitted),
        Parametric("circle", "circle", of_circle, CIRCLE, build_circle, press_circle, basis.fitted),
    )
