"""Interface of stroke models: named parameters with units and ranges, and the shapes they describe.

The rest follows from the shape: `model.raster` makes coverage images at any heading and position, `shape.outline()` is
the boundary, `shape.area_mm2` the area, and all are differentiable in the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from brushloop.model.brush import Brush, DomainError
from brushloop.model.ccdbsm import CcdBsm, as_batch, ccdbsm
from brushloop.model.outline import Shape

Number = float | Tensor
Values = dict[str, Tensor]


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter of a stroke model: `low` to `high` are allowed, both included, in `unit` ("1" for none)."""

    name: str
    unit: str
    low: float
    high: float
    default: float
    meaning: str

    def check(self, values: Tensor) -> None:
        """Raise DomainError for the first value outside the range; NaN counts as outside."""
        bad = ~((values >= self.low) & (values <= self.high))
        if bad.any():
            unit = "" if self.unit == "1" else f" {self.unit}"
            raise DomainError(self.name, float(values[bad][0]), f"[{self.low:g}, {self.high:g}]{unit}", self.meaning)


class StrokeModel(Protocol):
    """A family of shapes with named parameters, and its prediction for a press."""

    @property
    def name(self) -> str:
        """The key on the command line and in files."""
        ...

    @property
    def label(self) -> str:
        """The name as a report prints it."""
        ...

    @property
    def fitted(self) -> bool:
        """Whether any parameter was fitted to captures; a report must state this with each score."""
        ...

    @property
    def definition(self) -> str:
        """What the shape is, in one sentence."""
        ...

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """The parameters in order."""
        ...

    def shape(self, values: Mapping[str, Number]) -> Shape:
        """The shapes of these parameters, scalars or (B,) broadcast to one (B,); omitted ones take their defaults.

        Raises DomainError outside a range or the model's domain, and ValueError for an unknown name.
        """
        ...

    def of_press(self, depth_mm: Number, tilt_deg: Number) -> Values:
        """The model's parameters for a press to depth H at tilt alpha, each (B,); may raise DomainError."""
        ...

    def profile(self, depth_mm: Number, tilt_deg: Number) -> Shape:
        """The shapes of presses, `shape(of_press(...))`; may raise DomainError."""
        ...


@dataclass(frozen=True, slots=True)
class Basis:
    """The CCD-BSM, with its brush and lambda, from which the other models of that brush are derived.

    `fitted` says that lambda (or the brush) was fitted to captures; every derived model is then marked as fitted.
    """

    brush: Brush
    lam: float = math.pi
    fitted: bool = False

    def mark(self, depth_mm: Number, tilt_deg: Number) -> CcdBsm:
        """The CCD-BSM mark of a press; raises DomainError outside its domain."""
        return ccdbsm(self.brush, depth_mm, tilt_deg, self.lam)


@dataclass(frozen=True, slots=True)
class Parametric:
    """A `StrokeModel` from two functions: `build`, parameters to shape, and `press`, (H, alpha) to parameters."""

    name: str
    label: str
    definition: str
    parameters: tuple[ParameterSpec, ...]
    build: Callable[[Values], Shape]
    press: Callable[[Number, Number], Values]
    fitted: bool = False

    def shape(self, values: Mapping[str, Number]) -> Shape:
        """See `StrokeModel.shape`."""
        unknown = values.keys() - {spec.name for spec in self.parameters}
        if unknown:
            raise ValueError(f"{self.name} has no parameter {sorted(unknown)[0]!r}")
        batch = as_batch(*(values.get(spec.name, spec.default) for spec in self.parameters))
        for spec, value in zip(self.parameters, batch, strict=True):
            spec.check(value.detach())
        return self.build({spec.name: value for spec, value in zip(self.parameters, batch, strict=True)})

    def of_press(self, depth_mm: Number, tilt_deg: Number) -> Values:
        """See `StrokeModel.of_press`."""
        return self.press(depth_mm, tilt_deg)

    def profile(self, depth_mm: Number, tilt_deg: Number) -> Shape:
        """See `StrokeModel.profile`."""
        return self.shape(self.of_press(depth_mm, tilt_deg))
