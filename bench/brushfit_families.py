"""Families of made-up brushes for the prior of the brush fit: marks in closed form, unlike those of the loopback rig.

`leaf`: two halves of superellipses. `spine`: discs along a line whose radius grows toward the heel. `bezier`: two cubic
curves. Sizes, growth with depth and tilt, and place are drawn from ranges that were chosen before anything was fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.fit.captures import Grid, Pressed
from brushloop.model.fitted import chance_within

Floats = NDArray[np.float64]
Shape = Callable[[Floats], Floats]
"""Half width over the greatest one, by place: -1 at the tip, 0 at the widest place, 1 at the heel."""
FAMILIES = ("leaf", "spine", "bezier")
BRUSHES = 6
EDGE_MM = 0.05


@dataclass(frozen=True, slots=True)
class MadeUp:
    """A made-up brush: its shape and how that grows."""

    radius_mm: float
    length_mm: float
    shape: Shape
    reach_mm: float
    """Length of the mark at 15 mm."""
    reach_offset_mm: float
    reach_power: float
    heel_share: float
    half_mm: float
    """Half width at 15 mm."""
    half_offset_mm: float
    half_power: float
    place_mm: float
    place_gain: float
    lean: float
    width_tilt: float
    length_tilt: float
    heel_tilt: float

    def press(self, depth_mm: float, tilt_deg: float, grid: Grid) -> Pressed:
        """The press, without any variation."""
        reach = self.reach_mm * ((depth_mm + self.reach_offset_mm) / 15.0) ** self.reach_power
        reach *= 1.0 + self.length_tilt * tilt_deg
        half = self.half_mm * ((depth_mm + self.half_offset_mm) / 15.0) ** self.half_power
        half *= 1.0 + self.width_tilt * tilt_deg
        widest = self.place_mm - self.place_gain * depth_mm + self.lean * depth_mm * math.tan(math.radians(tilt_deg))
        heel = reach * self.heel_share * max(0.3, 1.0 + self.heel_tilt * tilt_deg)
        tip = reach * (1.0 - self.heel_share)
        u = grid.x_mm - widest
        share = np.where(u > 0.0, u / heel, u / tip)
        edge = np.where(np.abs(share) < 1.0, half * self.shape(np.clip(share, -1.0, 1.0)), -1.0)
        return Pressed(depth_mm, tilt_deg, chance_within(np.stack([edge, edge]), grid.y_mm, EDGE_MM))


def made_up(family: str, number: int, seed: int = 0) -> MadeUp:
    """The brush of that number in a family. Raises KeyError for another family."""
    rng = np.random.default_rng([seed, number, FAMILIES.index(family)])
    shape = {"leaf": _leaf, "spine": _spine, "bezier": _bezier}[family](rng)
    return MadeUp(
        radius_mm=rng.uniform(4.5, 7.0),
        length_mm=rng.uniform(40.0, 54.0),
        shape=shape,
        reach_mm=rng.uniform(8.0, 20.0),
        reach_offset_mm=rng.uniform(-2.0, 2.0),
        reach_power=rng.uniform(0.7, 1.3),
        heel_share=rng.uniform(0.15, 0.6),
        half_mm=rng.uniform(2.0, 4.0),
        half_offset_mm=rng.uniform(-1.0, 1.0),
        half_power=rng.uniform(0.8, 1.7),
        place_mm=rng.uniform(-2.0, 2.0),
        place_gain=rng.uniform(-0.2, 0.3),
        lean=rng.uniform(-0.3, 1.3),
        width_tilt=rng.normal(0.0, 0.01),
        length_tilt=rng.normal(0.0, 0.01),
        heel_tilt=rng.normal(0.0, 0.02),
    )


def _leaf(rng: np.random.Generator) -> Shape:
    heel_round, tip_round = rng.uniform(1.2, 3.0, 2)
    heel_power, tip_power = rng.uniform(0.5, 1.6), rng.uniform(0.6, 2.2)

    def shape(share: Floats) -> Floats:
        away = np.abs(share)
        return np.where(share > 0.0, (1.0 - away**heel_round) ** heel_power, (1.0 - away**tip_round) ** tip_power)

    return shape


def _spine(rng: np.random.Generator) -> Shape:
    power, flat = rng.uniform(0.6, 1.6), rng.uniform(0.3, 1.0)
    centres = np.linspace(-1.0, 0.0, 150)
    radii = (1.0 + centres) ** power

    def shape(share: Floats) -> Floats:
        away = (share[:, None] - centres) / np.where(share[:, None] > centres, flat, 0.5 * flat)
        return np.sqrt(np.maximum(radii**2 - away**2, 0.0)).max(axis=1)

    return shape


def _bezier(rng: np.random.Generator) -> Shape:
    shoulder = rng.uniform(0.0, 1.0)
    t = np.linspace(0.0, 1.0, 200)
    place = 3.0 * (1.0 - t) * t * t * shoulder + t**3
    width = 0.15 * (1.0 - t) ** 2 * t + 3.0 * (1.0 - t) * t * t + t**3
    return lambda share: np.interp(1.0 - np.abs(share), place, width)
