"""The stroke models by name: what a validation compares and a report describes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from model import baselines
from model.ccdbsm import Brush, CcdBsm, ccdbsm
from model.profile import Profile


class UnknownModelError(LookupError):
    """A model name that is not registered; carries the `name` and the `known` names."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        super().__init__(f"unknown stroke model {name!r}; known: {', '.join(known)}")
        self.name = name
        self.known = known


class StrokeModel(Protocol):
    """Something that predicts the mark of a press from depth and tilt."""

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
        """Whether any parameter was fitted to captures; a report must say so beside a score."""
        ...

    @property
    def definition(self) -> str:
        """What the shape is, in one sentence."""
        ...

    def profile(self, height_mm: float | Tensor, tilt_deg: float | Tensor) -> Profile:
        """The shapes of presses to depth H at tilt alpha, scalars or (B,); may raise DomainError."""
        ...


@dataclass(frozen=True, slots=True)
class ClosedFormModel:
    """A `StrokeModel` that is a function of the CCD-BSM mark of one brush; nothing is fitted."""

    name: str
    label: str
    definition: str
    brush: Brush
    lam: float
    shape: Callable[[CcdBsm], Profile]
    fitted: bool = False

    def profile(self, height_mm: float | Tensor, tilt_deg: float | Tensor) -> Profile:
        """The shapes of presses to depth H at tilt alpha, scalars or (B,); may raise DomainError."""
        return self.shape(ccdbsm(self.brush, height_mm, tilt_deg, self.lam))


def stroke_models(brush: Brush, lam: float = math.pi) -> dict[str, StrokeModel]:
    """The closed-form models of one brush by name: ccd-bsm, and the baselines sized by it."""
    table: tuple[tuple[str, str, str, Callable[[CcdBsm], Profile]], ...] = (
        (
            "ccd-bsm",
            "CCD-BSM",
            f"Half an ellipse at the heel and two parabolas to the tip (Eq. 1-5), dilation {lam:.4g}.",
            lambda mark: mark,
        ),
        (
            "ellipse",
            "ellipse",
            "The bounding ellipse of the CCD-BSM mark: same length and width.",
            baselines.ellipse,
        ),
        (
            "circle",
            "circle",
            "The circle whose diameter is the length of the CCD-BSM mark.",
            baselines.circle,
        ),
        ("line", "line", "The capsule with the length and width of the CCD-BSM mark.", baselines.line),
    )
    return {
        name: ClosedFormModel(name=name, label=label, definition=definition, brush=brush, lam=lam, shape=shape)
        for name, label, definition, shape in table
    }


def stroke_model(name: str, brush: Brush, lam: float = math.pi) -> StrokeModel:
    """The model of that name for one brush; raises UnknownModelError, which lists the known names."""
    models = stroke_models(brush, lam)
    if name not in models:
        raise UnknownModelError(name, tuple(models))
    return models[name]
