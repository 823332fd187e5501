"""The prior knowledge of a brush: mean and covariance of the parameters over known brushes.

`prior.json` holds the parameters of brushes of several families of shape, each fitted to many strokes
(`python -m bench.prior` makes it). Each family counts with the square root of its number of brushes, so that
one large family does not make the others implausible. The covariance is shrunk toward its diagonal, because there are
few brushes, and it has a floor, because the next brush may belong to none of the families.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from brushloop.calibrate.artefact import Frozen
from brushloop.model.fitted import NAMES, PARAMETERS, published

Floats = NDArray[np.float64]

FILE = Path(__file__).with_name("prior.json")
SHRINKAGE = 0.3
FLOOR = 0.15
"""Least standard deviation of a parameter, in units of its spread."""


class KnownBrush(Frozen):
    """A brush of the prior: its parameters, in the order of `NAMES`."""

    name: str
    family: str
    values: tuple[float, ...] = Field(min_length=len(NAMES), max_length=len(NAMES))


class KnownBrushes(Frozen):
    """The contents of `prior.json`."""

    brushes: tuple[KnownBrush, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A normal distribution of the parameters over their spreads: `mean` (17,) and `precision` (17, 17)."""

    mean: Floats
    precision: Floats

    @property
    def values(self) -> Floats:
        """The mean in the parameters' own units, within their bounds."""
        low, high = (np.array([getattr(p, end) for p in PARAMETERS]) for end in ("low", "high"))
        return np.clip(published() + spreads() * self.mean, low, high)

    def off(self, values: Floats) -> Floats:
        """Distance of parameters from the mean, over their spreads, (17,)."""
        return (values - published()) / spreads() - self.mean


def spreads() -> Floats:
    """The plausible spread of each parameter, (17,)."""
    return np.array([parameter.spread for parameter in PARAMETERS])


def about(values: Floats) -> Prior:
    """A prior that holds only the plausible spread of each parameter about these values (17,)."""
    return Prior((values - published()) / spreads(), np.eye(len(NAMES)))


@cache
def learned(without_families: tuple[str, ...] = ()) -> Prior:
    """The prior from `prior.json`; a bench leaves out the family that it scores."""
    known = KnownBrushes.model_validate(json.loads(FILE.read_text(encoding="utf-8"))).brushes
    return of_brushes([b for b in known if b.family not in without_families])


def of_brushes(known: Sequence[KnownBrush]) -> Prior:
    """The prior from these brushes. Raises ValueError for fewer than two."""
    if len(known) < 2:
        raise ValueError("a prior needs at least two brushes")
    families = [brush.family for brush in known]
    weights = np.array([families.count(family) ** -0.5 for family in families])
    weights /= weights.sum()
    off = (np.array([brush.values for brush in known]) - published()) / spreads()
    mean = weights @ off
    covariance = (off - mean).T @ ((off - mean) * weights[:, None]) / (1.0 - np.sum(weights**2))
    covariance += SHRINKAGE * (np.diag(np.diag(covariance)) - covariance)
    widened = np.asarray(covariance + FLOOR**2 * np.eye(len(mean)), np.float64)
    return Prior(mean, np.asarray(np.linalg.solve(widened, np.eye(len(mean))), np.float64))
