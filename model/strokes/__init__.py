"""Stroke models by name: what a validation compares, a report describes and a generator is trained on.

A model is a file in this folder with a function `models(basis) -> tuple[StrokeModel, ...]`; it is found automatically.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.model.ccdbsm import Brush, CcdBsm, ccdbsm
from brushloop.model.outline import Array, Outline, as_batch

# The paper's H and alpha; H as a share of its brush's 48 mm, so that the conditions lie in the domain of any brush.
DEPTHS = tuple(depth_mm / 48 for depth_mm in (11.0, 13.0, 15.0, 17.0, 20.0))
TILTS_DEG = (0.0, 5.0, 10.0)
Profile = Callable[[Array, Array], Outline]
"""Outlines of presses to depths H in mm at tilts alpha in deg, scalars or (B,); may raise DomainError."""


class UnknownModelError(LookupError):
    """A model name that is not registered; carries the `name` and the `known` names."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        super().__init__(f"unknown stroke model {name!r}; known: {', '.join(known)}")
        self.name = name
        self.known = known


@dataclass(frozen=True, slots=True)
class StrokeModel:
    """What the mark of a press looks like."""

    name: str
    """The key on the command line and in files."""
    label: str
    """The name as a report prints it."""
    definition: str
    """What the shape is, in one sentence."""
    profile: Profile
    fitted: bool = False
    """Whether any parameter was fitted to captures; a report must state this with each score."""


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The mark that a model predicts for a press."""

    model: str
    image: NDArray[np.float32]
    """(128, 128) share of each pixel that is ink, at .3 mm/px, with the zero-touch point at .76 of the width."""
    outline_mm: Array
    """(n, 2) points along its edge, from where the brush axis meets the paper; the ferrule leans toward positive x."""

    def _repr_html_(self) -> str:
        points = " ".join(f"{x:.2f},{-y:.2f}" for x, y in self.outline_mm)
        return f'<svg viewBox="-40 -20 60 40" width="360"><polygon points="{points}"/></svg>'


@dataclass(frozen=True, slots=True)
class Basis:
    """The CCD-BSM, with its brush and lambda, from which the other models of that brush are derived.

    `fitted` says that lambda (or the brush) was fitted to captures; every derived model is then marked as fitted.
    """

    brush: Brush
    lam: float = math.pi
    fitted: bool = False

    def mark(self, depth_mm: Array, tilt_deg: Array) -> CcdBsm:
        """The CCD-BSM mark of a press; raises DomainError outside its domain."""
        return ccdbsm(self.brush, depth_mm, tilt_deg, self.lam)

    def regressed(self, measure: Callable[[CcdBsm], Mapping[str, Array]]) -> Callable[[Array, Array], dict[str, Array]]:
        """A function (H, alpha) -> parameters: `measure` of the marks at the paper's 15 conditions, regressed once.

        Without captures the regression adds no information about real ink. The function raises DomainError where
        CCD-BSM has no mark.
        """
        planes: list[Plane] = []

        def parameters(depth_mm: Array, tilt_deg: Array) -> dict[str, Array]:
            self.mark(depth_mm, tilt_deg)
            if not planes:
                length_mm = float(np.ravel(self.brush.length_mm)[0])
                conditions = np.meshgrid(np.multiply(length_mm, DEPTHS), TILTS_DEG, indexing="ij")
                depth, tilt = (part.ravel() for part in conditions)
                planes.append(fit_plane(depth, tilt, measure(self.mark(depth, tilt))))
            return planes[0].at(*as_batch(depth_mm, tilt_deg))

        return parameters


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Parameters as c0 + c1 H + c2 H alpha: `coefficients` (P, 3) for the P `names`.

    Wang and Min regress a Bezier stroke's lengths on the descending height and the tilt angle. Here the effect of tilt
    is proportional to depth, as is every length of CCD-BSM, so a regressed stroke stays valid far from the conditions.
    """

    names: tuple[str, ...]
    coefficients: Array

    def at(self, depth_mm: Array, tilt_deg: Array) -> dict[str, Array]:
        """The parameters at H and alpha: floats or arrays of one shape, which each parameter has too."""
        rows = zip(self.names, self.coefficients.tolist(), strict=True)
        return {name: a + depth_mm * (b + c * tilt_deg) for name, (a, b, c) in rows}


def fit_plane(depth_mm: Array, tilt_deg: Array, values: Mapping[str, Array]) -> Plane:
    """The least-squares fit to values (N,) at H and alpha (N,), for captures or marks alike.

    Raises ValueError if the conditions do not span a plane: at least two depths and two tilts are needed.
    """
    depth, tilt = np.asarray(depth_mm, np.float64), np.asarray(tilt_deg, np.float64)
    design = np.column_stack([np.ones_like(depth), depth, depth * tilt])
    targets = np.column_stack([np.asarray(value, np.float64) for value in values.values()])
    coefficients, _, rank, _ = np.linalg.lstsq(design, targets)
    if rank < 3:
        raise ValueError(f"{len(design)} conditions do not span depth and tilt: two depths and two tilts are needed")
    return Plane(tuple(values), coefficients.T)


def stroke_models(brush: Brush, lam: float = math.pi, *, fitted: bool = False) -> dict[str, StrokeModel]:
    """Every model of one brush by name: ccd-bsm first, then the others by name.

    `fitted` says that lambda or the brush was fitted to captures. Raises ValueError if two files claim one name.
    """
    basis = Basis(brush, lam, fitted)
    models: dict[str, StrokeModel] = {}
    for file in pkgutil.iter_modules(__path__):
        for model in importlib.import_module(f"{__name__}.{file.name}").models(basis):
            if model.name in models:
                raise ValueError(f"two stroke models are called {model.name!r}, one in {file.name}")
            models[model.name] = model
    return {name: models[name] for name in sorted(models, key=lambda name: (name != "ccd-bsm", name))}


def stroke_model(name: str, brush: Brush, lam: float = math.pi, *, fitted: bool = False) -> StrokeModel:
    """The model of that name for one brush; raises UnknownModelError, which lists the known names."""
    models = stroke_models(brush, lam, fitted=fitted)
    if name not in models:
        raise UnknownModelError(name, tuple(models))
    return models[name]
