"""CCD-BSM fitted to one brush: lengths follow the geometry of Eq. 2-5, and constants that the paper fixes are fitted.

With h = H + h0, c = h / 15 mm, and CCD-BSM's own O3A, O4O3 and O3C at (h, alpha):
    tip = tip_gain O4O3 c^(length_power - 1) (1 + length_tilt alpha),
    heel the same with heel_gain O3A, times (1 + heel_tilt alpha),
    half width = lam O3C c^(width_power - 1) (1 + width_tilt alpha),
    profile = core sqrt(1 - u^6) + half width (1 - u^round)^power on either side (the paper: no core, u^2, power 1/2 at
    the heel and 1 at the tip).
The widest place lies at lean H tan(alpha) + origin_mm + origin_gain h from the point where the tip touched, in the
direction in which the ferrule leans; friction holds the tip back, so lean may be < 1.
The two ends may differ from these lengths, the half width from the profile, and the middle of the mark from the
brush's axis, by what `FittedPress` calls residuals.
The defaults are CCD-BSM as published.

What the presses of a brush do not determine has the values that a prior expects: the mean and precision of the
parameters over brushes of several families of shape, each fitted to many strokes (`python -m bench.prior` makes
`prior.json`). Each family counts with the square root of its number of brushes, so that a large one does not make the
others implausible. The covariance is shrunk toward its diagonal, because there are few brushes, and it has a floor,
because the next brush may belong to none of the families.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.model.ccdbsm import DomainError, basic_lengths
from brushloop.model.outline import Array, Outline, as_batch, closed
from brushloop.model.strokes import StrokeModel

Floats = NDArray[np.float64]

NAME = "ccd-bsm-fitted"
DEPTH_MM = 15.0
"""Depth at which powers and edges are centred: the middle of the paper's range."""
DEPTH_SPAN_MM, TILT_DEG = 4.5, 5.0
TERMS = 6
MODES = 12
"""Number of polynomials along the mark of which the residuals of its half width and of its middle consist."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One fitted number: its start value, its plausible spread about that, and its bounds."""

    name: str
    unit: str
    start: float
    spread: float
    low: float
    high: float
    meaning: str


PARAMETERS = (
    Parameter("lam", "1", math.pi, 1.5, 0.3, 10.0, "dilation across the axis"),
    Parameter("h0_mm", "mm", 0.0, 2.0, -8.0, 12.0, "zero offset: the ink is that of a press deeper by this much"),
    Parameter("origin_mm", "mm", 0.0, 3.0, -15.0, 15.0, "the widest place, from the point of touch"),
    Parameter("heel_gain", "1", 1.0, 4.0, 0.1, 15.0, "ratio of the heel side's length to O3A"),
    Parameter("tip_gain", "1", 1.0, 0.5, 0.1, 3.0, "ratio of the tip side's length to O4O3"),
    Parameter("origin_gain", "1", 0.0, 0.5, -1.5, 1.0, "shift of the widest place by depth"),
    Parameter("heel_power", "1", 0.5, 0.5, 0.1, 4.0, "sharpness of the heel"),
    Parameter("heel_round", "1", 2.0, 1.0, 0.6, 6.0, "roundness of the heel side"),
    Parameter("tip_power", "1", 1.0, 0.7, 0.1, 5.0, "sharpness of the tip"),
    Parameter("tip_round", "1", 2.0, 1.0, 0.6, 6.0, "roundness of the tip side"),
    Parameter("core_mm", "mm", 0.0, 0.4, 0.0, 2.0, "half width that even the lightest touch leaves: blunt ends"),
    Parameter("width_power", "1", 1.0, 0.5, 0.2, 2.5, "growth of the width with depth"),
    Parameter("length_power", "1", 1.0, 0.4, 0.2, 2.5, "growth of the length with depth"),
    Parameter("width_tilt", "1/deg", 0.0, 0.02, -0.1, 0.1, "growth of the width with tilt"),
    Parameter("length_tilt", "1/deg", 0.0, 0.02, -0.1, 0.1, "growth of the length with tilt"),
    Parameter("lean", "1", 1.0, 0.5, -2.0, 3.0, "share of H tan(alpha) by which the widest place moves with tilt"),
    Parameter("heel_tilt", "1/deg", 0.0, 0.03, -0.09, 0.2, "growth of the heel side with tilt, beyond length_tilt"),
)
NAMES = tuple(parameter.name for parameter in PARAMETERS)
PRIOR = Path(__file__).with_name("prior.json")
SHRINKAGE = 0.3
FLOOR = 0.15
"""Least standard deviation of a parameter, in units of its spread."""


def published() -> Floats:
    """The parameters of CCD-BSM as published, (17,)."""
    return np.array([parameter.start for parameter in PARAMETERS])


def spreads() -> Floats:
    """The plausible spread of each parameter, (17,)."""
    return np.array([parameter.spread for parameter in PARAMETERS])


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A normal distribution of the parameters over their spreads: `mean` (17,) and `precision` (17, 17)."""

    mean: Floats
    precision: Floats

    @classmethod
    def of_brushes(cls, known: Sequence[tuple[str, Floats]]) -> Prior:
        """The prior from the families and the parameters (17,) of these brushes."""
        families = [family for family, _ in known]
        weights = np.array([families.count(family) ** -0.5 for family in families])
        weights /= weights.sum()
        off = (np.array([values for _, values in known]) - published()) / spreads()
        mean = weights @ off
        covariance = (off - mean).T @ ((off - mean) * weights[:, None]) / (1.0 - np.sum(weights**2))
        covariance += SHRINKAGE * (np.diag(np.diag(covariance)) - covariance)
        return cls(mean, np.linalg.inv(covariance + FLOOR**2 * np.eye(len(mean))))

    @property
    def values(self) -> Floats:
        """The mean in the parameters' own units, within their bounds."""
        low, high = (np.array([getattr(p, end) for p in PARAMETERS]) for end in ("low", "high"))
        return np.clip(published() + spreads() * self.mean, low, high)

    def off(self, values: Floats) -> Floats:
        """Distance of parameters from the mean, over their spreads, (17,)."""
        return (values - published()) / spreads() - self.mean


@cache
def learned(brushes: str = "all") -> Prior:
    """The prior of `PRIOR`, which also holds the one that the bench of a family uses, without that family."""
    prior = json.loads(PRIOR.read_text(encoding="utf-8"))[brushes]
    return Prior(np.array(prior["mean"]), np.array(prior["precision"]))


@dataclass(frozen=True, slots=True)
class Sizes:
    """The marks of presses, mm: offset of the widest place from the point of touch, the two sides, the half width.

    All have the shape of the presses' depths, or of brushes and presses if the brush is a batch.
    """

    widest: Floats
    tip: Floats
    heel: Floats
    half: Floats

    def share(self, x_mm: Floats) -> Floats:
        """How far x (N,) from the point of touch lies along the marks (..., N): 0 at the tip, 1 at the heel."""
        return (x_mm - (self.widest - self.tip)[..., None]) / (self.tip + self.heel)[..., None]


@dataclass(frozen=True, slots=True, eq=False)
class FittedPress:
    """A calibrated brush: `values` (17,) in the order of `PARAMETERS`, with residuals in mm.

    `across` (2, MODES, TERMS) are the residuals of the half width and of the middle, whose tip may lie beside the axis:
    `modes` along the mark, each with the terms of `command_terms`. `ends` (2, TERMS) are those of the lengths of the
    tip's and the heel's side. `values` (K, 1, 17) are those of K brushes, whose sizes and widths come as (K, ...).
    """

    radius_mm: float
    length_mm: float
    values: Floats = field(default_factory=published)
    across: Floats = field(default_factory=lambda: np.zeros((2, MODES, TERMS)))
    ends: Floats = field(default_factory=lambda: np.zeros((2, TERMS)))

    def sizes(self, depth_mm: Array, tilt_deg: Array, further_mm: Array = 0.0) -> Sizes:
        """The sizes of marks at depths and tilts of one shape, numbers or (N,).

        `further_mm` (..., 2) is added to the sides of the tip and the heel. Raises DomainError outside the domain:
        h <= 0, or a tilt outside [0, 80) deg.
        """
        p = dict(zip(NAMES, np.moveaxis(self.values, -1, 0), strict=True))
        h = depth_mm + p["h0_mm"]
        if not (np.all(h > 0.0) and np.all(np.greater(depth_mm, 0.0))):
            allowed = f"({max(0.0, -float(np.min(p['h0_mm']))):g}, inf)"
            raise DomainError("depth_mm", float(np.min(depth_mm)), allowed, "the fitted brush starts to mark there")
        outside = np.atleast_1d(tilt_deg)[~np.atleast_1d(np.less_equal(0.0, tilt_deg) & np.less(tilt_deg, 80.0))]
        if len(outside):
            raise DomainError("tilt_deg", float(outside[0]), "[0, 80)")
        alpha = np.radians(tilt_deg)
        o3a, o3c, o4o3 = basic_lengths(h, alpha, self.radius_mm, self.length_mm, np)
        share = h / DEPTH_MM
        long = share ** (p["length_power"] - 1.0) * np.maximum(0.05, 1.0 + p["length_tilt"] * tilt_deg)
        wide = share ** (p["width_power"] - 1.0) * np.maximum(0.05, 1.0 + p["width_tilt"] * tilt_deg)
        widest = p["lean"] * depth_mm * np.tan(alpha) + p["origin_mm"] + p["origin_gain"] * h
        heel = p["heel_gain"] * o3a * long * np.maximum(0.05, 1.0 + p["heel_tilt"] * tilt_deg)
        tip = p["tip_gain"] * o4o3 * long
        further = np.moveaxis(command_terms(depth_mm, tilt_deg) @ self.ends.T + further_mm, -1, 0)
        tip, heel = (np.maximum(side + add, 0.3 * side) for side, add in zip((tip, heel), further, strict=True))
        return Sizes(widest, tip, heel, p["lam"] * o3c * wide)

    def half_width(self, sizes: Sizes, x_mm: Floats) -> Floats:
        """Half width (..., N) of the profile of marks at x (N,) from the point of touch, mm.

        Beyond an end it is minus the distance to it.
        """
        heel_power, heel_round, tip_power, tip_round, core = np.moveaxis(self.values[..., 6:11, None], -2, 0)
        u = x_mm - sizes.widest[..., None]
        at_heel = u > 0.0
        long = np.where(at_heel, sizes.heel[..., None], sizes.tip[..., None])
        share = np.minimum(np.abs(u) / long, 1.0)
        fall = 1.0 - share ** np.where(at_heel, heel_round, tip_round)
        width = sizes.half[..., None] * fall ** np.where(at_heel, heel_power, tip_power)
        blunt = np.sqrt(1.0 - np.square(share) * np.square(np.square(share)))
        return width + core * blunt - np.maximum(np.abs(u) - long, 0.0)

    def mark(self, depth_mm: Array, tilt_deg: Array, x_mm: Floats) -> tuple[Floats, Floats]:
        """Half width, as `half_width`, and middle y of marks at x (N,), (..., N) mm each."""
        s = self.sizes(depth_mm, tilt_deg)
        weights = np.einsum("smt,...t->...sm", self.across, command_terms(depth_mm, tilt_deg))
        further, middle = np.moveaxis(weights @ np.swapaxes(modes(s.share(x_mm)), -1, -2), -2, 0)
        half = self.half_width(s, x_mm)
        return half + np.where(half < -1e-9, 0.0, further), middle  # at an end, half is 0 but for rounding

    def chance(self, depth_mm: float, tilt_deg: float, x_mm: Floats, y_mm: Floats, spread_mm: float) -> Floats:
        """The probability of ink (len(y_mm), len(x_mm)) if edges vary by `spread_mm`; y upward from the touch."""
        half, middle = self.mark(depth_mm, tilt_deg, x_mm)
        return chance_within(half, y_mm[:, None] - middle, spread_mm)

    def outline(self, depth_mm: Array, tilt_deg: Array, points: int = 97) -> Outline:
        """The boundaries through `points` points of each edge (an odd number), x from the point of touch, y upward."""
        depth, tilt = as_batch(depth_mm, tilt_deg)
        s = self.sizes(depth, tilt)
        # Points are denser at both ends, where the outline turns fastest.
        share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, points))
        x = (s.widest - s.tip)[:, None] + share * (s.tip + s.heel)[:, None]
        half, middle = self.mark(depth, tilt, x)
        half = np.maximum(half, 0.0)
        return closed(np.stack([x, middle - half], axis=-1), np.stack([x, middle + half], axis=-1)[:, ::-1])


def chance_within(half_mm: Floats, off_mm: Floats, spread_mm: float) -> Floats:
    """The probability of ink `off_mm` from the middle of a mark; `spread_mm` is the logistic scale of its edges."""
    inside = half_mm - np.abs(off_mm)
    return 1.0 / (1.0 + np.exp(-np.clip(inside / spread_mm, -30.0, 30.0)))


def modes(share: Floats) -> Floats:
    """Chebyshev polynomials of 1 - 2 share (..., MODES), finest at both ends; share is 0 at the tip, 1 at the heel."""
    return np.cos(np.arccos(1.0 - 2.0 * np.clip(share, 0.0, 1.0))[..., None] * np.arange(MODES))


def command_terms(depth_mm: Array, tilt_deg: Array) -> Floats:
    """The terms of a residual, (..., TERMS): 1, depth, tilt, their product and their squares, about their middles."""
    h, a = (depth_mm - DEPTH_MM) / DEPTH_SPAN_MM, (tilt_deg - TILT_DEG) / TILT_DEG
    return np.stack([np.ones_like(h), h, a, h * a, h * h, a * a], axis=-1)


def fitted_model(press: FittedPress, label: str = "CCD-BSM fitted") -> StrokeModel:
    """The stroke model of a calibrated brush: its origin is where the brush axis meets the paper, as in every model."""

    def profile(depth_mm: Array, tilt_deg: Array) -> Outline:
        depth, tilt = as_batch(depth_mm, tilt_deg)
        outline = press.outline(depth, tilt)
        outline.points[..., 0] -= (depth * np.tan(np.radians(tilt)))[:, None, None]
        return outline

    definition = "CCD-BSM's lengths with gains, powers, profile and middle fitted to captured strokes."
    return StrokeModel(NAME, label, definition, profile, fitted=True)
