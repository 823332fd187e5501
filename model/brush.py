"""The brush of a stroke model, and the error of a parameter outside a model's domain. No torch here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


class DomainError(ValueError):
    """A parameter outside the domain; carries its `name`, the first bad `value` and the `allowed` range."""

    def __init__(self, name: str, value: float, allowed: str, hint: str = "") -> None:
        super().__init__(f"{name} = {value:g} is outside {allowed}" + (f"; {hint}" if hint else ""))
        self.name = name
        self.value = value
        self.allowed = allowed


@dataclass(frozen=True, slots=True)
class Brush:
    """The hair bundle as a cone: largest radius R and length L, mm; both must be positive, else DomainError.

    R and L are floats, or (B,) tensors for gradients with respect to the brush.
    """

    radius_mm: float | Tensor = 6.0
    length_mm: float | Tensor = 48.0

    def __post_init__(self) -> None:
        for name, value in (("radius_mm", self.radius_mm), ("length_mm", self.length_mm)):
            require_positive(name, value)


def require_positive(name: str, value: float | Tensor) -> None:
    """Raise DomainError unless every element is positive and finite."""
    if isinstance(value, (int, float)):
        bad = [] if value > 0 and math.isfinite(value) else [value]
    else:
        values = value.detach().reshape(-1)
        bad = values[~((values > 0) & values.isfinite())].tolist()
    if bad:
        raise DomainError(name, float(bad[0]), "(0, inf)")
