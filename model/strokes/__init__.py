"""The stroke models by name: what a validation compares, a report describes and a generator is trained on.

A model is a file in this folder with a function `models(basis) -> tuple[StrokeModel, ...]`; it is found automatically.
"""

from __future__ import annotations

import importlib
import math
import pkgutil

from brushloop.model.brush import Brush
from brushloop.model.protocol import Basis, ParameterSpec, StrokeModel

__all__ = ["Basis", "ParameterSpec", "StrokeModel", "UnknownModelError", "stroke_model", "stroke_models"]


class UnknownModelError(LookupError):
    """A model name that is not registered; carries the `name` and the `known` names."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        super().__init__(f"unknown stroke model {name!r}; known: {', '.join(known)}")
        self.name = name
        self.known = known


def stroke_models(brush: Brush, lam: float = math.pi, *, fitted: bool = False) -> dict[str, StrokeModel]:
    """Every model of one brush by name: ccd-bsm first, then the others by name.

    `fitted` says that lambda or the brush was fitted to captures. Raises ValueError if two files claim one name.
    """
    basis = Basis(brush, lam, fitted)
    found: dict[str, StrokeModel] = {}
    for file in pkgutil.iter_modules(__path__):
        for model in importlib.import_module(f"{__name__}.{file.name}").models(basis):
            if model.name in found:
                raise ValueError(f"two stroke models are called {model.name!r}, one in {file.name}")
            found[model.name] = model
    return {name: found[name] for name in sorted(found, key=lambda name: (name != "ccd-bsm", name))}


def stroke_model(name: str, brush: Brush, lam: float = math.pi, *, fitted: bool = False) -> StrokeModel:
    """The model of that name for one brush; raises UnknownModelError, which lists the known names."""
    models = stroke_models(brush, lam, fitted=fitted)
    if name not in models:
        raise UnknownModelError(name, tuple(models))
    return models[name]
