"""A stroke model: an ellipse as long as the CCD-BSM mark and half as wide as it is long.

Put such a file into `model/strokes/`; being there is enough, and `brushloop validate` then has a row for it.
"""

from __future__ import annotations

from brushloop.model.outline import Array, Outline
from brushloop.model.strokes import Basis, StrokeModel
from brushloop.model.strokes.peers import ellipse


def models(basis: Basis) -> tuple[StrokeModel, ...]:
    """The models that this file adds, for one brush."""

    def drop(depth_mm: Array, tilt_deg: Array) -> Outline:
        mark = basis.mark(depth_mm, tilt_deg)
        return ellipse(mark.middle_mm, 0.5 * mark.length_mm, 0.25 * mark.length_mm)

    definition = "The ellipse over the length of the CCD-BSM mark, half as wide as it is long."
    return (StrokeModel("drop", "drop", definition, drop, basis.fitted),)
