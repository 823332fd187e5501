"""A stroke model: an ellipse as long as the CCD-BSM mark and half as wide as it is long.

Put such a file into `model/strokes/`; being there is enough. `brushloop validate` then has a row for it, and
`brushloop train --model drop` can train a generator on it.
"""

from __future__ import annotations

from brushloop.model import baselines
from brushloop.model.protocol import Basis, Number, ParameterSpec, Parametric, StrokeModel, Values

PARAMETERS = (
    ParameterSpec("centre_mm", "mm", -200, 200, -10, "x of the centre, on the stroke axis"),
    ParameterSpec("half_length_mm", "mm", 0.001, 400, 12, "half the length"),
)


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The models that this file adds, for one brush."""

    def press(depth_mm: Number, tilt_deg: Number) -> Values:
        circle = baselines.circle(basis.mark(depth_mm, tilt_deg))
        return {"centre_mm": circle.centre_mm, "half_length_mm": circle.semi_x_mm}

    return (
        Parametric(
            name="drop",
            label="drop",
            definition="The ellipse over the length of the CCD-BSM mark, half as wide as it is long.",
            parameters=PARAMETERS,
            build=lambda v: baselines.Ellipse(v["centre_mm"], v["half_length_mm"], 0.5 * v["half_length_mm"]),
            press=press,
            fitted=basis.fitted,
        ),
    )
