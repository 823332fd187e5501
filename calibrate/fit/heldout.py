"""How well a fit predicts cells that it has not seen, beside the ceiling and its peers."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.compare.similarity import csim, ssim
from calibrate.fit.bezier import refit_bezier
from calibrate.fit.fit import SPREAD_MM, Fit, Grid, Pressed, refit
from model.fitted import FittedPress

Cell = tuple[float, float]
CEILING, FITTED, BEZIER, UNCALIBRATED = "same-cell template", "fitted", "refitted Bezier", "uncalibrated"
Images = NDArray[np.floating]
Predict = Callable[[float, float], Images]


@dataclass(frozen=True, slots=True)
class HeldOut:
    """One model over held-out strokes, binary images, percent."""

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
    """A fitted brush as images, without torch."""
    return lambda height, tilt: press.chance(height, tilt, grid.x_mm, grid.y_mm, SPREAD_MM)


def leave_cell_out(fit: Fit, strokes: Sequence[Pressed], grid: Grid, uncalibrated: Predict) -> list[HeldOut]:
    """Each cell predicted by fits to all other cells. Raises ValueError with fewer than two cells.

    `uncalibrated` gives the image of a press before any fit. Peers that cannot be had are left out: a template needs
    three strokes of a cell, a regressed Bezier two depths and two tilts among the others.
    """
    cells = by_cell(strokes)
    if len(cells) < 2:
        raise ValueError("leaving a cell out needs at least two cells")
    scores: dict[str, list[tuple[float, float]]] = {}
    for cell, held in cells.items():
        others = [stroke for key, group in cells.items() if key != cell for stroke in group]
        images = {FITTED: predictor(refit(fit, others, grid).press, grid)(*cell), UNCALIBRATED: uncalibrated(*cell)}
        with contextlib.suppress(ValueError):  # the other cells span no plane
            images[BEZIER] = refit_bezier(others, grid).image(*cell, grid)
        for k, stroke in enumerate(held):
            for name, image in images.items():
                scores.setdefault(name, []).append(_score(image, stroke.ink))
            if len(held) >= 3:
                template = np.mean([other.ink > 0.5 for m, other in enumerate(held) if m != k], axis=0)
                scores.setdefault(CEILING, []).append(_score(template, stroke.ink))
    order = [name for name in (CEILING, FITTED, BEZIER, UNCALIBRATED) if name in scores]
    rows: list[HeldOut] = []
    for name in order:
        mean = 100.0 * np.mean(scores[name], axis=0)
        rows.append(HeldOut(name, float(mean[0]), float(mean[1]), len(scores[name])))
    return rows


def _score(predicted: Images, ink: Images) -> tuple[float, float]:
    seen, truth = (np.asarray(image > 0.5, np.float32) for image in (predicted, ink))
    if not seen.any() or not truth.any():
        return 0.0, 0.0
    return csim(seen, truth), ssim(seen, truth)
