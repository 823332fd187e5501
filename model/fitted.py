"""CCD-BSM fitted to one brush: lengths follow the geometry of Eq. 2-5, and constants that the paper fixes are fitted.

With h = H + h0, c = h / 15 mm, and CCD-BSM's own O3A, O4O3 and O3C at (h, alpha):
    tip = tip_gain O4O3 c^(length_power - 1) (1 + length_tilt alpha),
    heel the same with heel_gain O3A, times (1 + heel_tilt alpha),
    half width = lam O3C c^(width_power - 1) (1 + width_tilt alpha),
    profile = core sqrt(1 - u^6) + half width (1 - u^round)^power on either side (the paper: no core, u^2, power 1/2 at
    the heel and 1 at the tip).
The widest place lies at lean H tan(alpha) + origin_mm + origin_gain h from the point where the tip touched, in the
direction in which the ferrule leans; friction holds the tip back, so lean may be < 1.
The defaults are CCD-BSM as published. No torch here, so that a rig PC can evaluate it too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEPTH_MM = 15.0
"""Depth at which powers and edges are centred: the middle of the paper's range."""
DEPTH_SPAN_MM, TILT_DEG = 4.5, 5.0
TERMS = 5
MODES = 10
"""Number of sines along the mark by which each edge may differ from the profile."""


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
    Parameter("h0_mm", "mm", 0.0, 2.0, -8.0, 12.0, "zero offset: the ink is that of a press so much deeper"),
    Parameter("origin_mm", "mm", 0.0, 3.0, -15.0, 15.0, "the widest place, from the point of touch"),
    Parameter("heel_gain", "1", 1.0, 4.0, 0.1, 15.0, "length of the heel side over O3A"),
    Parameter("tip_gain", "1", 1.0, 0.5, 0.1, 3.0, "length of the tip side over O4O3"),
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
    Parameter(
        "heel_tilt", "1/deg", 0.0, 0.03, -0.09, 0.2, "growth of the heel side with tilt, beside that of the length"
    ),
)
NAMES = tuple(parameter.name for parameter in PARAMETERS)


def published() -> Floats:
    """The parameters of CCD-BSM as published, (17,)."""
    return np.array([parameter.start for parameter in PARAMETERS])


@dataclass(frozen=True, slots=True)
class Sizes:
    """The mark of one press, mm: offset of the widest place from the point of touch, the two sides, the half width."""

    widest: float
    tip: float
    heel: float
    half: float


@dataclass(frozen=True, slots=True, eq=False)
class FittedPress:
    """A calibrated brush: `values` (17,) in the order of `PARAMETERS`, `edges` (2, MODES, TERMS) mm.

    The edges are the residuals of the upper and the lower edge from the profile: sines along the mark, each with the
    terms of `command_terms`.
    """

    radius_mm: float
    length_mm: float
    values: Floats = field(default_factory=published)
    edges: Floats = field(default_factory=lambda: np.zeros((2, MODES, TERMS)))

    def sizes(self, height_mm: float, tilt_deg: float) -> Sizes:
        """The mark's sizes. Raises ValueError outside the domain: h <= 0, or a tilt outside [0, 80) deg."""
        p = dict(zip(NAMES, self.values.tolist(), strict=True))
        h = height_mm + p["h0_mm"]
        if not (h > 0.0 and height_mm > 0.0):
            raise ValueError(f"height_mm = {height_mm:g}: the fitted brush starts to mark at {max(0.0, -p['h0_mm']):g}")
        if not 0.0 <= tilt_deg < 80.0:
            raise ValueError(f"tilt_deg = {tilt_deg:g} is outside [0, 80)")
        alpha, theta = math.radians(tilt_deg), math.atan(self.radius_mm / self.length_mm)
        o3a = h * (math.tan(alpha) - math.tan(alpha - theta))
        o3c = h * self.radius_mm / (self.length_mm * math.cos(alpha))
        o4o3 = h / math.cos(alpha - theta) + o3a
        share = h / DEPTH_MM
        long = share ** (p["length_power"] - 1.0) * max(0.05, 1.0 + p["length_tilt"] * tilt_deg)
        wide = share ** (p["width_power"] - 1.0) * max(0.05, 1.0 + p["width_tilt"] * tilt_deg)
        widest = p["lean"] * height_mm * math.tan(alpha) + p["origin_mm"] + p["origin_gain"] * h
        heel = p["heel_gain"] * o3a * long * max(0.05, 1.0 + p["heel_tilt"] * tilt_deg)
        return Sizes(widest, p["tip_gain"] * o4o3 * long, heel, p["lam"] * o3c * wide)

    def half_width(self, height_mm: float, tilt_deg: float, x_mm: Floats) -> Floats:
        """Half width of the profile at x from the point of touch, mm, any shape; beyond an end, minus the distance."""
        s = self.sizes(height_mm, tilt_deg)
        heel_power, heel_round, tip_power, tip_round, core = self.values[6:11]
        u = x_mm - s.widest
        heel, tip = np.clip(u / s.heel, 0.0, 1.0), np.clip(-u / s.tip, 0.0, 1.0)
        width = s.half * (1.0 - heel**heel_round) ** heel_power * (1.0 - tip**tip_round) ** tip_power
        width += core * np.sqrt(1.0 - (heel + tip) ** 6)  # one of the two is 0
        return width - np.maximum(u - s.heel, 0.0) - np.maximum(-u - s.tip, 0.0)

    def edge_offsets(self, height_mm: float, tilt_deg: float, x_mm: Floats) -> tuple[Floats, Floats]:
        """Offsets of the upper and the lower edge from the half width at x, mm; zero beyond the ends."""
        s = self.sizes(height_mm, tilt_deg)
        waves = modes((x_mm - s.widest + s.tip) / (s.tip + s.heel))
        upper, lower = self.edges @ command_terms(height_mm, tilt_deg)
        return waves @ upper, waves @ lower

    def chance(self, height_mm: float, tilt_deg: float, x_mm: Floats, y_mm: Floats, spread_mm: float) -> Floats:
        """The probability of ink (len(y_mm), len(x_mm)) if edges vary by `spread_mm`; y upward from the touch."""
        width = self.half_width(height_mm, tilt_deg, x_mm)
        upper, lower = self.edge_offsets(height_mm, tilt_deg, x_mm)
        side = np.where(y_mm[:, None] > 0.0, upper[None], lower[None])
        inside = np.clip((width[None] + side - np.abs(y_mm)[:, None]) / spread_mm, -30.0, 30.0)
        return 1.0 / (1.0 + np.exp(-inside))

    def outline(self, height_mm: float, tilt_deg: float, points: int = 97) -> Floats:
        """The boundary as a counter-clockwise polygon (2 points, 2) mm, x from the point of touch, y upward."""
        s = self.sizes(height_mm, tilt_deg)
        # Points are denser at both ends, where the outline turns fastest.
        share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, points))
        x = s.widest - s.tip + share * (s.tip + s.heel)
        width = np.maximum(self.half_width(height_mm, tilt_deg, x), 0.0)
        upper, lower = self.edge_offsets(height_mm, tilt_deg, x)
        top, bottom = np.maximum(width + upper, 0.0), -np.maximum(width + lower, 0.0)
        return np.concatenate([np.column_stack([x, bottom]), np.column_stack([x, top])[::-1]])


def modes(share: Floats) -> Floats:
    """sin(k pi share) for k = 1 .. MODES, (..., MODES); share runs from 0 at the tip to 1 at the heel."""
    return np.sin(np.pi * np.clip(share, 0.0, 1.0)[..., None] * np.arange(1, MODES + 1))


def command_terms(height_mm: float, tilt_deg: float) -> Floats:
    """The terms of an edge, (TERMS,): 1, depth, tilt, their product and depth squared, centred on their middles."""
    h, a = (height_mm - DEPTH_MM) / DEPTH_SPAN_MM, (tilt_deg - TILT_DEG) / TILT_DEG
    return np.array([1.0, h, a, h * a, h * h])
