"""What a generator learns to draw: the exact coverage of presses over ranges of depth and tilt, in one placement."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.outline import Outline
from brushloop.model.raster import centred_origin, coverage
from brushloop.model.strokes import StrokeModel, UnknownModelError, stroke_model

Floats = NDArray[np.floating[Any]]
Range = tuple[float, float]
INPUTS: tuple[str, str] = ("depth_mm", "tilt_deg")
"""The generator's inputs in order: H and alpha."""
ANCHOR_SHARE = (0.76, 0.5)
"""Position of the zero-touch point in the image, from the left and the top, as in the validation's mm field."""


class Placement(StrEnum):
    """How a stroke is put into the image, at heading 0."""

    CENTRED = "centred"
    """Bounding box centred: the longest press of the paper's grid just fits at 0.2 mm/px."""
    ZERO_TOUCH = "zero-touch"
    """The zero-touch point at ANCHOR_SHARE; O3 lies H tan(alpha) from it."""


class Target(BaseModel):
    """Presses of one brush by a stroke model, the ranges of the inputs, and the placement of strokes in the image."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    model: Annotated[str, Field(max_length=64)] = "ccd-bsm"
    """Name of the stroke model; with `qbc` or `bezier`, the paper's figure 12."""
    radius_mm: Annotated[float, Field(gt=0, le=100)] = 6.0
    length_mm: Annotated[float, Field(gt=0, le=400)] = 48.0
    lam: Annotated[float, Field(gt=0, le=10)] = math.pi
    fitted_brush: bool = False
    """Whether lambda or the brush was fitted to captures; if so, every report says it."""
    depth_mm: Range = (11.0, 20.0)
    """Range of H; the defaults of both ranges are the paper's."""
    tilt_deg: Range = (0.0, 10.0)
    """Range of alpha."""
    placement: Placement = Placement.CENTRED
    px_mm: Annotated[float, Field(ge=0.01, le=10)] = 0.2
    size_px: Literal[32, 64, 128, 256] = 128

    @model_validator(mode="after")
    def _check(self) -> Target:
        for name in INPUTS:
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} = [{low:g}, {high:g}] must grow")
        try:
            self.stroke_model.profile(np.array(self.depth_mm), np.array(self.tilt_deg))
        except (DomainError, UnknownModelError) as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def stroke_model(self) -> StrokeModel:
        """The stroke model of the brush."""
        return stroke_model(self.model, Brush(self.radius_mm, self.length_mm), self.lam, fitted=self.fitted_brush)

    def check(self, inputs: Floats) -> None:
        """Raise DomainError for the first of (N, 2) inputs that lies outside its range; NaN counts as outside."""
        for name, column, unit in zip(INPUTS, inputs.T, ("mm", "deg"), strict=True):
            low, high = getattr(self, name)
            bad = column[~((column >= low) & (column <= high))]
            if len(bad):
                raise DomainError(name, float(bad[0]), f"[{low:g}, {high:g}] {unit}", "the range of the generator")

    def origin_mm(self, inputs: Floats, outline: Outline | None = None) -> Floats:
        """Where O3 lies in the images of (N, 2) inputs, (N, 2) from the left and the top.

        `outline` is what is drawn, if it is not the stroke model's.
        """
        depth, tilt = np.asarray(inputs, np.float64).T
        if self.placement is Placement.CENTRED:
            drawn = outline or self.stroke_model.profile(depth, tilt)
            return centred_origin(drawn, size_px=self.size_px, px_mm=self.px_mm)
        side_mm = self.size_px * self.px_mm
        x = ANCHOR_SHARE[0] * side_mm + depth * np.tan(np.radians(tilt))
        return np.column_stack((x, np.full_like(x, ANCHOR_SHARE[1] * side_mm)))

    def images(self, inputs: Floats, model: StrokeModel | None = None) -> NDArray[np.float32]:
        """Exact coverage of (N, 2) inputs, (N, size_px, size_px), drawn by another stroke model if one is given.

        May raise DomainError.
        """
        outline = (model or self.stroke_model).profile(*np.asarray(inputs, np.float64).T)
        return coverage(outline, self.origin_mm(inputs, outline), size_px=self.size_px, px_mm=self.px_mm)

    def draw(self, count: int, seed: tuple[int, ...]) -> NDArray[np.float32]:
        """`count` inputs drawn uniformly from the ranges, (count, 2)."""
        low, high = np.transpose([getattr(self, name) for name in INPUTS])
        return np.random.default_rng(seed).uniform(low, high, (count, 2)).astype(np.float32)
