"""`python -m bench.prior`: fit the brushes that the prior of the brush fit is made of, and write prior.json.

Its families: the two bristle sets from an independent simulation, and three families of made-up marks in closed form:
`leaf`, two halves of superellipses; `spine`, discs along a line whose radius grows toward the heel; `bezier`, two cubic
curves. Their sizes, growth with depth and tilt, and place are drawn from ranges that were chosen before anything was
fitted. Brushes of the loopback rig are not among them, so that scores on the rig are those of a brush that nobody knew.
Each brush is fitted with a prior about the published model, so the file does not depend on its earlier contents.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.brushes import BRISTLE_SETS, CELLS, bristle_session
from brushloop.calibrate.fit.fit import fit_presses
from brushloop.calibrate.presses import read_for_fit
from brushloop.model.fitted import NAMES, PRIOR, Prior, chance_within
from brushloop.model.presses import Grid, Presses

BRISTLE, NOT_BRISTLE = "bristle simulation", "without the bristle simulation"
SIZE_PX, PX_MM, TOUCH_MM = 128, 0.3, (29.1, 19.2)
"""The images of made-up marks, and where the tip touches on them, from the left and top edge."""
ROWS = slice(28, 100)
"""10.8 mm to either side: no press is thicker."""
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

    def ink(self, depth_mm: float, tilt_deg: float, grid: Grid) -> Floats:
        """The ink of a press, without any variation, (len(y_mm), len(x_mm))."""
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
        return chance_within(edge, grid.y_mm[:, None], EDGE_MM)


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


def known() -> Iterator[tuple[str, Floats]]:
    """Family and parameters of every brush of the prior. Raises BenchError where a bristle set is not at hand."""
    for name in BRISTLE_SETS:
        with tempfile.TemporaryDirectory() as folder:
            _, presses, _ = read_for_fit(bristle_session(Path(folder) / name, name))
        yield BRISTLE, _fitted(presses)
    centres = np.asarray((np.arange(SIZE_PX) + 0.5) * PX_MM, np.float64)
    grid = Grid(centres - TOUCH_MM[0], (TOUCH_MM[1] - centres)[ROWS])
    for family in FAMILIES:
        for number in range(BRUSHES):
            brush = made_up(family, number)
            ink = np.array([brush.ink(*cell, grid) for cell in CELLS])
            presses = Presses(brush.radius_mm, brush.length_mm, grid, np.array(CELLS), ink)
            yield family, _fitted(presses)


def _fitted(presses: Presses) -> Floats:
    about_published = Prior(np.zeros(len(NAMES)), np.eye(len(NAMES)))
    return fit_presses(presses, residual=False, prior=about_published).values.round(5)


def main() -> None:
    """Write the prior of all brushes, and the one that the bench of the bristle simulation uses."""
    brushes = list(known())
    sets = {"all": brushes, NOT_BRISTLE: [brush for brush in brushes if brush[0] != BRISTLE]}
    priors = {name: Prior.of_brushes(known) for name, known in sets.items()}
    numbers = {name: {"mean": p.mean.tolist(), "precision": p.precision.tolist()} for name, p in priors.items()}
    PRIOR.write_text(json.dumps(numbers) + "\n", encoding="utf-8")
    sys.stdout.write(f"{len(brushes)} brushes: {PRIOR}\n")


if __name__ == "__main__":
    main()
