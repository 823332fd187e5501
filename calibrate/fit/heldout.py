"""How well a fit predicts cells that it has not seen, compared with the ceiling and with other models."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import SIZE_PX, Alignment, draw_loop, to_pixels
from brushloop.calibrate.compare.score import similarity
from brushloop.calibrate.fit.captures import SPREAD_MM, Cell, Floats, Grid, Pressed, by_cell, inked_rows
from brushloop.calibrate.fit.fit import fit_presses, zero_touches
from brushloop.calibrate.fit.prior import Prior
from brushloop.calibrate.pool import Scheduler, finished, threads
from brushloop.calibrate.stats import CEILING, Summary, average, ceiling_values, pair_means
from brushloop.calibrate.store import Arrays, Store, key_of
from brushloop.model.arrays import as_batch
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress
from brushloop.model.outline import Outline
from brushloop.model.strokes import Plane, fit_plane
from brushloop.model.strokes.peers import bezier
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, counted, unseen

BEZIER_SIZES = ("left_mm", "right_mm", "belly_mm", "shoulder")
FITTED, BEZIER, UNCALIBRATED = "fitted", "refitted Bezier", "uncalibrated"
Images = NDArray[np.floating]
Predict = Callable[[float, float], Images]
MAX_FOLDS = 15
"""Most folds: the paper's grid leaves out one cell at a time, a larger grid several."""
PER_CELL = 3
"""Presses of each other cell that a fit uses; more did not change it."""
MAX_STROKES = 60
One = TypeVar("One")
C = TypeVar("C", Cell, Condition)


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Scores of one model on held-out strokes, binary images, percent; of the ceiling, its estimate."""

    model: str
    csim: float
    ssim: float
    n: int
    below: Summary | None = None
    """Points of CSIM below the ceiling; None for the ceiling itself, and where no cell was pressed twice."""


def predictor(press: FittedPress, grid: Grid) -> Predict:
    """A function that draws the presses of a fitted brush, without torch."""
    return lambda height, tilt: press.chance(height, tilt, grid.x_mm, grid.y_mm, SPREAD_MM)


def folds(cells: Sequence[C], most: int = MAX_FOLDS) -> list[list[C]]:
    """Groups of cells that are left out together; none if there is only one cell."""
    ordered = sorted(set(cells))
    count = min(len(ordered), most)
    return [ordered[k::count] for k in range(count)] if len(ordered) > 1 else []


def without(cells: Mapping[C, Sequence[One]], fold: Sequence[C]) -> list[One]:
    """The strokes of all other cells that a fit uses."""
    others = [one for cell, group in cells.items() if cell not in fold for one in group[:PER_CELL]]
    return others[:: max(1, -(-len(others) // MAX_STROKES))]


@dataclass(frozen=True, slots=True)
class Refit:
    """A fit of the brush to some presses of a session, from the prior: it knows no other press of theirs."""

    strokes: tuple[Pressed, ...]
    """In 256 levels, cut to the rows with ink, so that equal presses are equal work for every command."""
    grid: Grid
    radius_mm: float
    length_mm: float
    prior: Prior | None = None

    @classmethod
    def of(
        cls, strokes: Sequence[Pressed], grid: Grid, radius_mm: float, length_mm: float, prior: Prior | None = None
    ) -> Refit:
        """The fit to these presses, whose ink is on the grid."""
        rows = inked_rows([one.ink for one in strokes], grid.px_mm)
        inks = (to_pixels(np.asarray(one.ink[rows], np.float32)) / 255.0 for one in strokes)
        cut = tuple(replace(one, ink=ink) for one, ink in zip(strokes, inks, strict=True))
        return cls(cut, Grid(grid.x_mm, grid.y_mm[rows]), radius_mm, length_mm, prior)

    @property
    def key(self) -> str:
        """Key in the store of finished work."""
        prior = () if self.prior is None else (self.prior.mean, self.prior.precision)
        presses = (part for one in self.strokes for part in (one.depth_mm, one.tilt_deg, one.ink))
        return key_of("refit", self.radius_mm, self.length_mm, self.grid.x_mm, self.grid.y_mm, *prior, *presses)


def refit(job: Refit) -> Arrays:
    """The numbers of the fitted brush."""
    press = fit_presses(job.strokes, job.grid, job.radius_mm, job.length_mm, prior=job.prior)
    return {"values": press.values, "edges": press.edges, "ends": press.ends}


def refits(
    jobs: Sequence[Refit], store: Store | None, scheduler: Scheduler, what: str = "", progress: Progress = unseen
) -> list[FittedPress]:
    """The fitted brush of each job; jobs that are not finished in the store run side by side."""
    keys = [job.key for job in jobs]
    unique = dict(zip(keys, jobs, strict=True))
    results = dict(counted(finished(scheduler, store, refit, unique.items()), what, len(unique), progress))
    return [FittedPress(job.radius_mm, job.length_mm, **results[key]) for key, job in zip(keys, jobs, strict=True)]


def leave_cell_out(
    strokes: Sequence[Pressed],
    grid: Grid,
    radius_mm: float,
    length_mm: float,
    prior: Prior | None = None,
    progress: Progress = unseen,
    store: Store | None = None,
) -> tuple[list[HeldOut], Floats]:
    """Score each cell as predicted by fits to other cells, and find its `zero_touches` for them, (cells, 2) mm.

    `brushloop validate` uses the same fits, which the store keeps. Both are empty for a single cell. Models without
    enough data are left out: the ceiling needs two strokes of a cell, a regressed Bezier two depths and two tilts among
    the others. Nothing moved between these presses, so every difference of a zero touch is an error of the model or of
    a press.
    """
    cells = by_cell(strokes)
    published = FittedPress(radius_mm, length_mm)
    scores, errors, left = Scores(), [np.empty((0, 2))], folds(list(cells))
    jobs = [Refit.of(without(cells, fold), grid, radius_mm, length_mm, prior) for fold in left]
    with threads() as scheduler:
        presses = refits(jobs, store, scheduler, "cells left out in turn", progress)
    for fold, job, press in zip(left, jobs, presses, strict=True):
        models: dict[str, Callable[[float, float], Outline]] = {FITTED: press.outline, UNCALIBRATED: published.outline}
        with contextlib.suppress(ValueError):  # the other cells are too few to fit a plane
            models[BEZIER] = refit_bezier(job.strokes, job.grid).outline
        for cell in fold:
            scores.add(cells[cell], dict(_images(models, cell, grid)))
            errors.append(zero_touches(press, cells[cell], grid))
    return scores.rows((CEILING, FITTED, BEZIER, UNCALIBRATED)), np.concatenate(errors)


def _images(
    models: Mapping[str, Callable[[float, float], Outline]], cell: Cell, grid: Grid
) -> Iterator[tuple[str, Images]]:
    for name, outline in models.items():
        with contextlib.suppress(DomainError):  # so light that the brush leaves no mark
            yield name, image_of(outline(*cell), grid)


class Scores:
    """Collects scores of held-out strokes by model, and of the pairs of strokes in their cell."""

    def __init__(self) -> None:
        self._found: dict[str, list[NDArray[np.float64]]] = {}
        self._cells: list[int] = []

    def add(self, held: Sequence[Pressed], images: Mapping[str, Images]) -> None:
        """Score the strokes of one cell by what each model predicts there, and in pairs."""
        inks = [_levels(stroke.ink) for stroke in held]
        nothing = np.full((len(inks), 2), np.nan)
        before = sum(map(len, self._found.get(CEILING, [])))
        pairs = pair_means(len(inks), lambda k, others: _scores(inks[k], [inks[j] for j in others]))
        for name in {*self._found, *images} - {CEILING}:
            found = nothing
            if name in images:
                found = np.concatenate([_scores(ink, [_levels(images[name])]) for ink in inks])
            self._found.setdefault(name, [np.full((before, 2), np.nan)]).append(found)
        self._found.setdefault(CEILING, []).append(pairs)
        self._cells += [1 + max(self._cells, default=-1)] * len(inks)

    def rows(self, order: Sequence[str]) -> list[HeldOut]:
        """Means in percent in this order; a model without a score is left out."""
        cells, rows = np.array(self._cells), list[HeldOut]()
        values = {name: 100.0 * np.concatenate(found) for name, found in self._found.items()}
        if CEILING in values:
            values[CEILING] = np.stack([ceiling_values(pairs, cells) for pairs in values[CEILING].T], axis=1)
        for name in order:
            known = np.isfinite(values[name][:, 0]) if name in values else np.zeros(0, np.bool_)
            if known.any():
                below = average(values[CEILING][:, 0] - values[name][:, 0], cells) if name != CEILING else None
                csim, ssim = values[name][known].mean(axis=0).tolist()
                rows.append(HeldOut(name, csim, ssim, int(known.sum()), below))
        return rows


@dataclass(frozen=True, slots=True)
class RefittedBezier:
    """The paper's Bezier baseline: ends, belly and shoulder as planes in (H, H alpha)."""

    plane: Plane

    def outline(self, depth_mm: float, tilt_deg: float) -> Outline:
        """The stroke, x from the point of touch."""
        left, right, belly, shoulder = self.plane.at(depth_mm, tilt_deg).values()
        right, belly, shoulder = max(right, left + 0.2), max(belly, 0.1), min(max(shoulder, 0.0), 1.0)
        return bezier(*as_batch(-left, right, belly, shoulder))


def image_of(loop: Outline, grid: Grid) -> Images:
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
        # The enclosed area is belly length (4 - s) / 5, as in `model.strokes.peers.bezier_sizes`.
        area = float(stroke.ink.sum()) * grid.px_mm**2
        rows.append((left, right, width, float(np.clip(4.0 - 5.0 * area / (width * (right - left)), 0.0, 1.0))))
    height, tilt = [s.depth_mm for s in strokes], [s.tilt_deg for s in strokes]
    return RefittedBezier(fit_plane(height, tilt, dict(zip(BEZIER_SIZES, np.array(rows).T, strict=True))))


def _levels(image: Images) -> NDArray[np.uint8]:
    """Ink or paper as 255 or 0, with blank rows up to the height of the field, which SSIM is averaged over."""
    blank = max(0, SIZE_PX - len(image))
    return np.pad(np.where(image > 0.5, 255, 0).astype(np.uint8), ((blank // 2, blank - blank // 2), (0, 0)))


def _scores(captured: NDArray[np.uint8], predicted: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """(n, 2) CSIM and SSIM; NaN where an image is blank."""
    nothing = (np.nan, np.nan)
    known = captured.any()
    return np.array(
        [similarity(captured / 255.0, p / 255.0, Alignment.MM) if known and p.any() else nothing for p in predicted]
    )
