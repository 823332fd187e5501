"""How well a fit predicts cells that it has not seen, compared with the ceiling and with other models."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare import Alignment, similarity
from brushloop.calibrate.fit.captures import Cell, Floats, Grid, Pressed, by_cell
from brushloop.calibrate.fit.descent import Prior, fit_presses
from brushloop.calibrate.stats import CEILING, Summary, ceiling_values, pair_means, summarise
from brushloop.calibrate.work import Arrays, Scheduler, Store, key_of, threads
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress
from brushloop.model.outline import Outline, as_batch
from brushloop.model.strokes import fit_plane
from brushloop.model.strokes.peers import bezier
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, counted, unseen

BEZIER_SIZES = ("left_mm", "right_mm", "belly_mm", "shoulder")
FITTED, BEZIER, UNCALIBRATED = "fitted", "refitted Bezier", "uncalibrated"
Images = NDArray[np.floating]
Draw = Callable[[float, float], Outline]
"""The mark of a press by depth and tilt, x from the point of touch."""
MAX_FOLDS = 15
"""Most folds: the paper's grid leaves out one cell at a time, a larger grid several."""
PER_CELL = 3
"""Presses of each other cell that a fit uses; more did not change it."""
MAX_STROKES = 60
FINE = 16
T = TypeVar("T")
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


Predicted = tuple[Sequence[Pressed], Mapping[str, Images]]
"""The presses of one cell, and what each model predicts there without them."""


def leave_out(cells: Mapping[C, Sequence[T]], most: int = MAX_FOLDS) -> list[tuple[list[C], list[T]]]:
    """Cells that are left out together, and the presses of all others that a fit uses; none if no press is left."""
    ordered = sorted(cells)
    folds = [ordered[k::most] for k in range(min(len(ordered), most))]
    return [(fold, others) for fold in folds if (others := _without(cells, fold))]


def _without(cells: Mapping[C, Sequence[T]], fold: Sequence[C]) -> list[T]:
    others = [press for cell, group in cells.items() if cell not in fold for press in group[:PER_CELL]]
    return others[:: max(1, -(-len(others) // MAX_STROKES))]


@dataclass(frozen=True, slots=True)
class Refit:
    """A fit of the brush to some presses of a session."""

    strokes: Sequence[Pressed]
    grid: Grid
    radius_mm: float
    length_mm: float
    prior: Prior | None = None
    start: Floats | None = None
    """Parameters (17,) of the fit to all presses, where the descent begins; None searches from the prior."""

    @property
    def key(self) -> str:
        """Key in the store of finished work."""
        prior = () if self.prior is None else (self.prior.mean, self.prior.precision)
        presses = (part for stroke in self.strokes for part in (stroke.depth_mm, stroke.tilt_deg, stroke.ink))
        grid = self.grid.x_mm, self.grid.y_mm
        return key_of("refit", self.radius_mm, self.length_mm, *grid, *prior, self.start, *presses)


def refit(job: Refit) -> Arrays:
    """The numbers of the fitted brush."""
    press = fit_presses(job.strokes, job.grid, job.radius_mm, job.length_mm, prior=job.prior, start=job.start)
    return {"values": press.values, "edges": press.edges, "ends": press.ends}


def refits(
    jobs: Sequence[Refit], store: Store | None, scheduler: Scheduler, what: str = "", progress: Progress = unseen
) -> list[FittedPress]:
    """The fitted brush of each job; jobs that are not finished in the store run side by side."""
    keys = [job.key for job in jobs]
    unique = dict(zip(keys, jobs, strict=True))
    results = dict(counted(scheduler.finished(refit, unique.items(), store), what, len(unique), progress))
    return [FittedPress(job.radius_mm, job.length_mm, **results[key]) for key, job in zip(keys, jobs, strict=True)]


def leave_cell_out(
    strokes: Sequence[Pressed],
    grid: Grid,
    press: FittedPress,
    prior: Prior | None = None,
    progress: Progress = unseen,
    store: Store | None = None,
) -> list[HeldOut]:
    """Score each cell as predicted by fits to other cells; empty for a single cell.

    The fits descend from `press`, the fit to all cells. `brushloop validate` uses the same fits, which the store keeps.
    Models without enough data are left out: the ceiling needs two strokes of a cell, a regressed Bezier two depths and
    two tilts among the others.
    """
    cells = by_cell(strokes)
    brush = press.radius_mm, press.length_mm
    published = FittedPress(*brush)
    left_out = leave_out(cells)
    jobs = [Refit(others, grid, *brush, prior, press.values) for _, others in left_out]
    with threads(1) as scheduler:  # a fit holds Python's lock nearly all the time: two at once take half as long again
        presses = refits(jobs, store, scheduler, "cells left out in turn", progress)
    predicted: list[Predicted] = []
    for (fold, others), refitted in zip(left_out, presses, strict=True):
        outlines: dict[str, Draw] = {FITTED: refitted.outline, UNCALIBRATED: published.outline}
        if (of_others := refit_bezier(others, grid)) is not None:
            outlines[BEZIER] = of_others
        for cell in fold:
            images: dict[str, Images] = {}
            for name, outline in outlines.items():
                with contextlib.suppress(DomainError):  # so light that the brush leaves no mark
                    images[name] = image_of(outline(*cell), grid)
            predicted.append((cells[cell], images))
    return held_out_scores(predicted, (FITTED, BEZIER, UNCALIBRATED))


def held_out_scores(predicted: Sequence[Predicted], models: Sequence[str]) -> list[HeldOut]:
    """The ceiling, then these models in this order; one without a score is left out."""
    values: dict[str, list[Floats]] = {name: [] for name in (CEILING, *models)}
    for presses, images in predicted:
        inks = np.array([_binary(press.ink) for press in presses])

        def score(k: int, others: list[int], inks: Floats = inks) -> Floats:
            return similarity(inks[k], inks[others], Alignment.MM)

        values[CEILING].append(pair_means(len(inks), score))
        for name in models:
            drawn = _binary(images[name]) if name in images else np.zeros_like(inks[0])
            values[name].append(similarity(drawn, inks, Alignment.MM))
    if not predicted:
        return []
    cells = np.repeat(np.arange(len(predicted)), [len(presses) for presses, _ in predicted])
    percent = {name: 100.0 * np.concatenate(scores) for name, scores in values.items()}
    ceiling = np.stack([ceiling_values(pairs, cells) for pairs in percent[CEILING].T], axis=1)
    rows: list[HeldOut] = []
    for name, scores in (percent | {CEILING: ceiling}).items():
        known = np.isfinite(scores[:, 0])
        if known.any():
            below = summarise(ceiling[:, 0] - scores[:, 0], cells) if name != CEILING else None
            csim, ssim = scores[known].mean(axis=0).tolist()
            rows.append(HeldOut(name, csim, ssim, int(known.sum()), below))
    return rows


def image_of(mark: Outline, grid: Grid) -> Images:
    """Coverage (len(y_mm), len(x_mm)) of a mark with one upper and one lower edge, sampled at `FINE` places a column.

    The compiled raster would be exact, but takes longer to load than all marks of a fit take to draw.
    """
    points = mark.polyline()[0]
    points = np.roll(points, -int(points[:, 0].argmin()), axis=0)  # from the tip along the lower edge, and back
    heel = int(points[:, 0].argmax())
    x_mm = (grid.x_mm[:, None] + grid.px_mm * ((np.arange(FINE) + 0.5) / FINE - 0.5)).ravel()
    lower, upper = points[: heel + 1], np.concatenate([points[heel:], points[:1]])[::-1]
    below, above = (np.interp(x_mm, edge[:, 0], edge[:, 1], left=0.0, right=0.0) for edge in (lower, upper))
    bottom_mm = grid.y_mm[:, None] - 0.5 * grid.px_mm
    inside = np.clip(above - bottom_mm, 0.0, grid.px_mm) - np.clip(below - bottom_mm, 0.0, grid.px_mm)
    return inside.reshape(len(grid.y_mm), -1, FINE).mean(axis=2) / grid.px_mm


def refit_bezier(strokes: Sequence[Pressed], grid: Grid) -> Draw | None:
    """The paper's Bezier baseline: ends, belly and shoulder of the strokes as planes in (H, H alpha).

    None where a stroke holds no ink, or the cells are too few for a plane.
    """
    rows: list[tuple[float, float, float, float]] = []
    for stroke in strokes:
        ink = stroke.ink > 0.5
        columns = np.flatnonzero(ink.any(axis=0))
        if not len(columns):
            return None
        left = float(grid.x_mm[columns[0]]) - 0.5 * grid.px_mm
        right = float(grid.x_mm[columns[-1]]) + 0.5 * grid.px_mm
        width = float(stroke.ink.sum(axis=0).max()) * grid.px_mm
        # The enclosed area is belly length (4 - s) / 5, as in `model.strokes.peers.bezier_sizes`.
        area = float(stroke.ink.sum()) * grid.px_mm**2
        rows.append((left, right, width, float(np.clip(4.0 - 5.0 * area / (width * (right - left)), 0.0, 1.0))))
    height, tilt = [s.depth_mm for s in strokes], [s.tilt_deg for s in strokes]
    try:
        plane = fit_plane(height, tilt, dict(zip(BEZIER_SIZES, np.array(rows).T, strict=True)))
    except ValueError:
        return None

    def outline(depth_mm: float, tilt_deg: float) -> Outline:
        left, right, belly, shoulder = plane.at(depth_mm, tilt_deg).values()
        right, belly, shoulder = max(right, left + 0.2), max(belly, 0.1), min(max(shoulder, 0.0), 1.0)
        return bezier(*as_batch(-left, right, belly, shoulder))

    return outline


def _binary(image: Images) -> Floats:
    """Ink or paper as 1 or 0."""
    return np.where(image > 0.5, 1.0, 0.0)
