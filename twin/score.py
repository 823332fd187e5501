"""How well a twin predicts cells that it was not fitted to, beside the ceiling and the refitted Bezier.

The cells are divided into three parts, each of which holds some of every depth and tilt; a twin fitted to two parts
predicts the third.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence

import numpy as np

from calibrate.fit.heldout import BEZIER, CEILING, HeldOut, Images, image_of, refit_bezier, score
from calibrate.fit.strokes import Grid, Pressed
from drivers.sim.brush.spec import BrushSpec
from twin.constants import Offset
from twin.drawing import Cell, draw

PARTS = 3
TWIN = "twin"
VOTES = 7
"""Presses of the twin that are averaged to one prediction."""
FIRST_SEED = 900
FEWEST = 3
"""Captures of a cell from which a template is made."""


def parts_of(cells: Sequence[Cell]) -> list[list[int]]:
    """Numbers of the cells in each part, along the diagonals of the grid of depths and tilts."""
    heights, tilts = sorted({h for h, _ in cells}), sorted({a for _, a in cells})
    diagonal = [(heights.index(h) + tilts.index(a)) % PARTS for h, a in cells]
    parts = [[k for k, at in enumerate(diagonal) if at == part] for part in range(PARTS)]
    return [part for part in parts if part and len(part) < len(cells)]


def predicted(spec: BrushSpec, offset: Offset, cells: Sequence[Cell], grid: Grid) -> dict[Cell, Images]:
    """Mean ink of several presses of the twin in each cell."""
    drawn = draw(spec, offset, cells, grid, VOTES, FIRST_SEED)
    return dict(zip(cells, drawn.mean(axis=1), strict=True))


class Scores:
    """Collects scores of held-out captures by model."""

    def __init__(self) -> None:
        self._found: dict[str, list[tuple[float, float]]] = {}

    def add(
        self, held: Mapping[Cell, Sequence[Pressed]], others: Sequence[Pressed], twin: Mapping[Cell, Images], grid: Grid
    ) -> None:
        """Score captures of held cells by the twin, a Bezier refitted to the others and their cell's template."""
        for cell, captures in held.items():
            images: dict[str, Images] = {TWIN: twin[cell]}
            with contextlib.suppress(ValueError):  # the other cells span no plane
                images[BEZIER] = image_of(refit_bezier(others, grid).outline(*cell), grid)
            for k, one in enumerate(captures):
                templates = dict(images)
                if len(captures) >= FEWEST:
                    rest = [other.ink > 0.5 for m, other in enumerate(captures) if m != k]
                    templates[CEILING] = np.mean(rest, axis=0)
                for name, image in templates.items():
                    self._found.setdefault(name, []).append(score(image, one.ink))

    def rows(self) -> list[HeldOut]:
        """Means in percent: ceiling, twin, Bezier; a model without a score is left out."""
        rows: list[HeldOut] = []
        for name in (CEILING, TWIN, BEZIER):
            if name in self._found:
                mean = 100.0 * np.mean(self._found[name], axis=0)
                rows.append(HeldOut(name, float(mean[0]), float(mean[1]), len(self._found[name])))
        return rows
