"""How well a fit predicts cells that it has not seen, compared with the ceiling and with other models."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.compare.images import draw_loop
from calibrate.compare.similarity import csim, ssim
from calibrate.fit.captures import SPREAD_MM, Grid, Pressed
from calibrate.fit.fit import Fit, refit
from model.fitted import FittedPress
from model.loops import BEZIER_PIECES, Loop, bezier_side, closed
from model.plane import Plane, fit_plane
from sessions.progress import Progress, counted, unseen

BEZIER_SIZES = ("left_mm", "right_mm", "belly_mm", "shoulder")
FEWEST_REPEATS = 3
"""Strokes of a cell from which one is compared with the others."""
Cell = tuple[float, float]
CEILING, FITTED, BEZIER, UNCALIBRATED = "same-cell template", "fitted", "refitted Bezier", "uncalibrated"
Images = NDArray[np.floating]
Predict = Callable[[float, float], Images]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Scores of one model on held-out strokes, binary images, percent."""

    model: str
    csim: float
    ssim: float
    n: int


def by_cell(strokes: Sequence[Pressed]) -> dict[Cell, list[Pressed]]:
    """The strokes of each (H, alpha)."""
    cells: dict[Cell, list[Pressed]] = {}
    for stroke in strokes:
        cells.setdefault((stroke.height_mm, stroke.tilt_deg), []).append(stroke)
    return dict(sorted(cells.items()))


def predictor(press: FittedPress, grid: Grid) -> Predict:
    """A function that draws the presses of a fitted brush, without torch."""
    return lambda height, tilt: press.chance(height, tilt, grid.x_mm, grid.y_mm, SPREAD_MM)


def leave_cell_out(fit: Fit, strokes: Sequence[Pressed], grid: Grid, progress: Progress = unseen) -> list[HeldOut]:
    """Score each cell as predicted by fits to all other cells. Raises ValueError with fewer than two cells.

    Models without enough data are left out: a template needs three strokes of a cell, a regressed Bezier two depths
    and two tilts among the others.
    """
    cells = by_cell(strokes)
    if len(cells) < 2:
        raise ValueError("leaving a cell out needs at least two cells")
    published = FittedPress(fit.press.radius_mm, fit.press.length_mm)
    scores = Scores()
    for cell, held in counted(cells.items(), "cells left out in turn", len(cells), progress):
        others = [stroke for key, group in cells.items() if key != cell for stroke in group]
        images = {
            FITTED: predictor(refit(fit.press, others, grid), grid)(*cell),
            UNCALIBRATED: image_of(published.outline(*cell), grid),
        }
        with contextlib.suppress(ValueError):  # the other cells are too few to fit a plane
            images[BEZIER] = image_of(refit_bezier(others, grid).outline(*cell), grid)
        scores.add(held, images)
    return scores.rows((CEILING, FITTED, BEZIER, UNCALIBRATED))


class Scores:
    """Collects scores of held-out strokes by model, and of the template of their own cell."""

    def __init__(self) -> None:
        self._found: dict[str, list[tuple[float, float]]] = {}

    def add(self, held: Sequence[Pressed], images: Mapping[str, Images]) -> None:
        """Score the strokes of one cell by what each model predicts there, and by the others of the cell."""
        for k, stroke in enumerate(held):
            for name, image in images.items():
                self._found.setdefault(name, []).append(_score(image, stroke.ink))
            if len(held) >= FEWEST_REPEATS:
                template = np.mean([other.ink > 0.5 for m, other in enumerate(held) if m != k], axis=0)
                self._found.setdefault(CEILING, []).append(_score(template, stroke.ink))

    def rows(self, order: Sequence[str]) -> list[HeldOut]:
        """Means in percent in this order; a model without a score is left out."""
        rows: list[HeldOut] = []
        for name in order:
            if name in self._found:
                mean = 100.0 * np.mean(self._found[name], axis=0)
                rows.append(HeldOut(name, float(mean[0]), float(mean[1]), len(self._found[name])))
        return rows


@dataclass(frozen=True, slots=True)
class RefittedBezier:
    """The paper's Bezier baseline: ends, belly and shoulder as planes in (H, H alpha)."""

    plane: Plane

    def outline(self, height_mm: float, tilt_deg: float) -> Loop:
        """The stroke, x from the point of touch."""
        left, right, belly, shoulder = self.plane.at(height_mm, tilt_deg).values()
        t = np.linspace(1.0, 0.0, 2 * BEZIER_PIECES + 1)
        right, belly, shoulder = max(right, left + 0.2), max(belly, 0.1), min(max(shoulder, 0.0), 1.0)
        x, y = bezier_side(t, -left, right, belly, shoulder)
        return closed(np.column_stack([x, y]), np.column_stack([x, -y])[::-1])


def image_of(loop: Loop, grid: Grid) -> Images:
    """Coverage (len(y_mm), len(x_mm)) of a mark on the grid."""
    corner = (0.5 * grid.px_mm - float(grid.x_mm[0]), 0.5 * grid.px_mm + float(grid.y_mm[0]))
    image = draw_loop(loop, [(grid.px_mm, *corner)], max(len(grid.x_mm), len(grid.y_mm)))[0]
    return image[: len(grid.y_mm), : len(grid.x_mm)]


def refit_bezier(strokes: Sequence[Pressed], grid: Grid) -> RefittedBezier:
    """Measure each stroke's ends, width and area, and regress. Raises ValueError for too few cells to fit a plane."""
    rows: list[tuple[float, float, float, float]] = []
    for stroke in strokes:
        ink = stroke.ink > 0.5
        columns = np.flatnonzero(ink.any(axis=0))
        if not len(columns):
            raise ValueError("a stroke without ink cannot be measured")
        left = float(grid.x_mm[columns[0]]) - 0.5 * grid.px_mm
        right = float(grid.x_mm[columns[-1]]) + 0.5 * grid.px_mm
        width = float(stroke.ink.sum(axis=0).max()) * grid.px_mm
        # The enclosed area is belly length (4 - s) / 5, as in `model.strokes.bezier`.
        area = float(stroke.ink.sum()) * grid.px_mm**2
        rows.append((left, right, width, float(np.clip(4.0 - 5.0 * area / (width * (right - left)), 0.0, 1.0))))
    height, tilt = [s.height_mm for s in strokes], [s.tilt_deg for s in strokes]
    return RefittedBezier(fit_plane(height, tilt, dict(zip(BEZIER_SIZES, np.array(rows).T, strict=True))))


def _score(predicted: Images, ink: Images) -> tuple[float, float]:
    seen, truth = (np.asarray(image > 0.5, np.float32) for image in (predicted, ink))
    if not seen.any() or not truth.any():
        return 0.0, 0.0
    return csim(seen, truth), ssim(seen, truth)
