"""The fitted brush of `model.fitted` as a stroke model: its outline for the rasterisers."""

from __future__ import annotations

import math

import numpy as np
import torch

from brushloop.model.ccdbsm import as_batch
from brushloop.model.fitted import NAME, FittedPress
from brushloop.model.outline import Outline
from brushloop.model.protocol import Number, ParameterSpec, Parametric, StrokeModel, Values

PARAMETERS = (
    ParameterSpec("depth_mm", "mm", 0.01, 200, 15, "H, how far the tip is pressed below the paper"),
    ParameterSpec("tilt_deg", "deg", 0, 79.9, 5, "alpha, the brush axis from the vertical"),
)


def fitted_model(press: FittedPress, label: str = "CCD-BSM fitted") -> StrokeModel:
    """The stroke model of a calibrated brush. Its shapes carry no gradient; the fit computes its derivatives itself.

    The shapes' origin is where the brush axis meets the paper, as in every model.
    """

    def of_press(depth_mm: Number, tilt_deg: Number) -> Values:
        height, tilt = as_batch(depth_mm, tilt_deg, dtype=torch.float64)
        for h, a in zip(height.tolist(), tilt.tolist(), strict=True):
            press.sizes(h, a)  # raises DomainError
        return {"depth_mm": height, "tilt_deg": tilt}

    definition = "CCD-BSM's lengths with gains, powers, profile and edges fitted to captured strokes."
    return Parametric(NAME, label, definition, PARAMETERS, lambda v: outlines(press, v), of_press, fitted=True)


def outlines(press: FittedPress, values: Values) -> Outline:
    """The outlines of presses, (B,) each."""
    height, tilt = values["depth_mm"], values["tilt_deg"]
    loops: list[np.ndarray] = []
    for h, a in zip(height.tolist(), tilt.tolist(), strict=True):
        loops.append(press.outline(h, a).points - [h * math.tan(math.radians(a)), 0.0])
    points = torch.as_tensor(np.array(loops), dtype=height.dtype, device=height.device)
    return Outline(points, torch.ones_like(points[..., 0, 0]))
