"""The fitted brush of `model.fitted` as a stroke model: its outline for the rasterisers."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from model.ccdbsm import DomainError, as_batch
from model.fitted import FittedPress
from model.outline import Outline, loop, through
from model.protocol import Number, ParameterSpec, Parametric, StrokeModel, Values

NAME = "ccd-bsm-fitted"
PARAMETERS = (
    ParameterSpec("height_mm", "mm", 0.01, 200, 15, "H, how far the tip is pressed below the paper"),
    ParameterSpec("tilt_deg", "deg", 0, 79.9, 5, "alpha, the brush axis from the vertical"),
)


def fitted_model(press: FittedPress, label: str = "CCD-BSM fitted") -> StrokeModel:
    """The stroke model of a calibrated brush. Its shapes carry no gradient; the fit computes its derivatives itself.

    The shapes' origin is where the brush axis meets the paper, as in every model.
    """

    def of_press(height_mm: Number, tilt_deg: Number) -> Values:
        height, tilt = as_batch(height_mm, tilt_deg, dtype=torch.float64)
        for h, a in zip(height.tolist(), tilt.tolist(), strict=True):
            try:
                press.sizes(h, a)
            except ValueError as error:
                name, value = ("height_mm", h) if str(error).startswith("height_mm") else ("tilt_deg", a)
                raise DomainError(name, value, "the domain of the fitted brush", str(error)) from None
        return {"height_mm": height, "tilt_deg": tilt}

    definition = (
        "CCD-BSM's lengths with gains, powers, profile and edges fitted to captured strokes: dilation "
        f"{press.values[0]:.3f}, zero offset {press.values[1]:+.2f} mm."
    )
    return Parametric(NAME, label, definition, PARAMETERS, lambda v: outlines(press, v), of_press, fitted=True)


def outlines(press: FittedPress, values: Values) -> Outline:
    """The outlines of presses, (B,) each."""
    height, tilt = values["height_mm"], values["tilt_deg"]
    polygons: list[np.ndarray] = []
    for h, a in zip(height.tolist(), tilt.tolist(), strict=True):
        polygon = press.outline(h, a)
        polygon[:, 0] -= h * math.tan(math.radians(a))
        polygons.append(polygon)
    points = torch.as_tensor(np.array(polygons), dtype=height.dtype, device=height.device)
    half = points.shape[1] // 2
    lower, upper = points[:, :half], points[:, half:]
    arcs = torch.cat(
        (through(lower), _straight(lower[:, -1], upper[:, 0]), through(upper), _straight(upper[:, -1], lower[:, 0])), 1
    )
    return Outline(arcs, torch.ones_like(arcs[..., 0, 0]))


def _straight(start: Tensor, end: Tensor) -> Tensor:
    return loop(((*start.T, *(0.5 * (start + end)).T, *end.T), 1.0)).points
