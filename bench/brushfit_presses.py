"""The presses that `bench brushfit` and `bench inversion` score on: one array of ink for each brush.

Brushes of the loopback rig are drawn by `drivers.sim.brush`, each press with a full load of ink. The two bristle sets
are photographs from an independent simulation (`../shared/data`), imported and cut out as any photographs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import BenchError
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.fit.captures import Grid, Pressed, read_presses
from brushloop.calibrate.stats import ceiling_values, pair_means
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.paper import Footprint
from brushloop.sessions.imports import ImportOptions, import_photographs

PX_MM, SIZE_PX = 0.3, 128
LEFT_MM, TOP_MM = 29.1, 19.2
ROWS = slice(28, 100)
"""The fit looks at 10.8 mm to either side: no press is thicker."""
INKED = 0.3
CELLS = tuple((height, tilt) for height in (11.0, 13.0, 15.0, 17.0, 20.0) for tilt in (0.0, 5.0, 10.0))
REPEATS = 10
BRISTLES = Path(__file__).resolve().parents[2] / "shared" / "data"
BRISTLE_SETS = ("bristle_presses_1", "bristle_presses_4")
Images = NDArray[np.float32]
Chosen = Sequence[tuple[int, int]]
"""Strokes, each as (number of its cell, number of the press)."""


@dataclass(frozen=True, slots=True)
class BrushPresses:
    """All presses of a brush: `ink` (15 cells, repeats, len(y_mm), len(x_mm)), coverage."""

    name: str
    radius_mm: float
    length_mm: float
    grid: Grid
    ink: Images

    def strokes(self, chosen: Chosen) -> list[Pressed]:
        """The chosen presses as data of a fit."""
        return [Pressed(*CELLS[c], self.ink[c, r]) for c, r in chosen]

    def every(self) -> list[Pressed]:
        """All presses."""
        return self.strokes([(c, r) for c in range(len(CELLS)) for r in range(self.ink.shape[1])])

    def gap(self, cells: Sequence[int], predict: Callable[[float, float], NDArray[np.floating]]) -> float:
        """CSIM points by which predictions of these cells fall short of the ceiling. A negative gap is a prediction
        that does better."""
        top, scored = self.ceiling(cells), list[float]()
        for c in cells:
            truth, seen = self.ink[c] > 0.5, predict(*CELLS[c]) > 0.5
            scored += binary_scores(np.broadcast_to(seen, truth.shape), truth)[:, 0].tolist()
        return top - 100.0 * float(np.mean(scored))

    def ceiling(self, cells: Sequence[int]) -> float:
        """CSIM of a perfect model in these cells, percent."""
        values: list[float] = []
        for c in cells:
            truth = self.ink[c] > 0.5
            pairs = pair_means(len(truth), partial(_pairs, truth))[:, 0]
            values += ceiling_values(100.0 * pairs, np.zeros(len(truth), np.int64)).tolist()
        return float(np.mean(values))


def _pairs(presses: NDArray[np.bool_], one: int, others: list[int]) -> NDArray[np.float64]:
    return binary_scores(presses[others], np.broadcast_to(presses[one], (len(others), *presses.shape[1:])))


def simulated(
    spec: BrushSpec, name: str, repeats: int = REPEATS, cells: Sequence[tuple[float, float]] = CELLS
) -> BrushPresses:
    """Presses of a brush of the loopback rig."""
    brush = Brush(spec)
    ink = np.empty((len(cells), repeats, SIZE_PX, SIZE_PX), np.float32)
    for c, (height, tilt) in enumerate(cells):
        for r in range(repeats):
            ink[c, r] = _on_field(brush.press(height, tilt, ink_load=1.0, press_seed=1000 * c + r))
    return BrushPresses(name, spec.radius_mm, spec.length_mm, grid(), ink[:, :, ROWS])


def bristles(name: str) -> BrushPresses:
    """Presses of an independent bristle simulation. Raises BenchError where the data set is not at hand."""
    photos = BRISTLES / name
    if not (photos / "strokes.csv").exists():
        raise BenchError(f"the bristle presses ({name}) are not beside this checkout")
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / name
        options = ImportOptions(kind="press", simulated=True)
        import_photographs(photos, photos / "strokes.csv", session, options, "bench", lambda: 1)
        captures = read_presses(session, Field())
    by_cell = [[s.ink for s in captures.strokes if (s.depth_mm, s.tilt_deg) == cell] for cell in CELLS]
    return BrushPresses(name, captures.radius_mm, captures.length_mm, captures.grid, np.array(by_cell, np.float32))


def grid() -> Grid:
    """Pixel centres around the point of touch, cut to the rows that the fit looks at."""
    centres = (np.arange(SIZE_PX) + 0.5) * PX_MM
    return Grid(np.asarray(centres - LEFT_MM, np.float64), np.asarray(TOP_MM - centres, np.float64)[ROWS])


def _on_field(mark: Footprint) -> Images:
    """(128, 128) share of each pixel that is inked."""
    side = round(SIZE_PX * PX_MM * mark.px_per_mm)
    field = np.zeros((side, side), np.float32)
    column, row = (round(mm * mark.px_per_mm - at) for mm, at in zip((LEFT_MM, TOP_MM), mark.origin_px, strict=True))
    ink = (mark.density > INKED)[max(0, -row) : side - row, max(0, -column) : side - column]
    top, left = max(0, row), max(0, column)
    field[top : top + ink.shape[0], left : left + ink.shape[1]] = ink
    return np.asarray(cv2.resize(field, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA), np.float32)
