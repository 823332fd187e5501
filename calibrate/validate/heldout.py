"""Held-out fits: each cell is left out in turn, and CCD-BSM and a Bezier are refitted to the others.

A job carries its strokes and returns numbers, so that it can run on any machine and its result can be stored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from brushloop.calibrate.compare.place import Field, Pixels, brush_of, loop_pixels, unpack
from brushloop.calibrate.fit.captures import Grid, Pressed, grid_of
from brushloop.calibrate.fit.heldout import (
    BEZIER_SIZES,
    MAX_FOLDS,
    PER_CELL,
    RefittedBezier,
    fit_held_out,
    folds,
    refit_bezier,
    without,
)
from brushloop.calibrate.pool import Scheduler
from brushloop.calibrate.validate.rows import Numbers, Rows
from brushloop.calibrate.validate.sources import LoadedSession
from brushloop.calibrate.validate.store import VERSION, Store
from brushloop.model.fitted import MODES, TERMS, FittedPress
from brushloop.model.strokes import Plane
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress


@dataclass(frozen=True, slots=True)
class RefitJob:
    """Fit the brush and a Bezier to these presses."""

    strokes: tuple[tuple[float, float, bytes], ...]
    """H, alpha and `Press.pixels`, whose last image is the coverage."""
    radius_mm: float
    length_mm: float
    view: Field
    fitted: bool = True
    """Whether to fit CCD-BSM; a Bezier always is."""

    @property
    def key(self) -> str:
        """Hash of everything that determines the result."""
        digest = hashlib.sha256(
            f"refit {VERSION} {self.radius_mm} {self.length_mm} {self.fitted} {self.view} {len(self.strokes)}".encode()
        )
        for height, tilt, pixels in self.strokes:
            digest.update(f"{height} {tilt} ".encode() + hashlib.sha256(pixels).digest())
        return digest.hexdigest()


@dataclass(frozen=True, slots=True)
class Refit:
    """What was fitted to the strokes of a job; None where they are too few for it."""

    fitted: dict[str, list[float]] | None
    """Values, edges and ends of the brush."""
    bezier: list[float] | None
    """Coefficients."""

    def press(self, radius_mm: float, length_mm: float) -> FittedPress:
        """The fitted brush, of a job that fits one."""
        assert self.fitted is not None
        edges, ends = (np.array(self.fitted[name]) for name in ("edges", "ends"))
        values = np.array(self.fitted["values"])
        return FittedPress(radius_mm, length_mm, values, edges.reshape(2, MODES, TERMS), ends.reshape(2, TERMS))


def refit_job(job: RefitJob) -> Refit:
    """Fit the brush, where the job asks for it, and a Bezier."""
    grid = grid_of(job.view)
    strokes = [Pressed(h, a, unpack(pixels)[-1].astype(np.float64) / 255.0) for h, a, pixels in job.strokes]
    fitted = None
    if job.fitted:
        press = fit_held_out(strokes, grid, job.radius_mm, job.length_mm)
        fitted = {name: getattr(press, name).ravel().tolist() for name in ("values", "edges", "ends")}
    return Refit(fitted, bezier_body(strokes, grid))


def bezier_body(strokes: Sequence[Pressed], grid: Grid) -> list[float] | None:
    """A refitted Bezier as plain data; None if the cells are too few to fit a plane."""
    try:
        coefficients = refit_bezier(strokes, grid).plane.coefficients
    except ValueError:
        return None
    return [float(value) for value in coefficients.ravel()]


def bezier_pixels(coefficients: Sequence[float], condition: Condition, view: Field) -> Pixels:
    """Images of a refitted Bezier, (len(KEYS), 128, 128)."""
    plane = Plane(BEZIER_SIZES, np.reshape(coefficients, (len(BEZIER_SIZES), 3)))
    return loop_pixels(RefittedBezier(plane).outline(condition.depth_mm, condition.tilt_deg), view)


def refits_by_cell(
    session: LoadedSession,
    number: int,
    rows: Rows,
    view: Field,
    scheduler: Scheduler,
    store: Store,
    progress: Progress,
    most_folds: int = MAX_FOLDS,
) -> dict[Condition, Refit]:
    """Refit for each cell of session `number` to uncut presses of its other cells; return the results by cell."""
    cells = {one: _first_uncut(rows, group) for session_of, one, group in rows.groups if session_of == number}
    brush, fitted = brush_of(session.header), session.fit is not None
    fits: dict[Condition, Refit] = {}
    jobs: list[tuple[str, RefitJob]] = []
    of_key: dict[str, list[Condition]] = {}
    for fold in folds(list(cells), most_folds):
        others = without(cells, fold)
        if not others:
            continue
        strokes = tuple(stroke_of(rows, row) for row in others)
        job = RefitJob(strokes, float(brush.radius_mm), float(brush.length_mm), view, fitted)
        of_key[job.key] = fold
        if job.key not in store:
            jobs.append((job.key, job))
    done = len(of_key) - len(jobs)
    for key, found in scheduler.run(refit_job, iter(jobs)):
        store.put(key, asdict(found))
        done += 1
        progress(f"{session.header.session_id}: cells left out in turn", done, len(of_key))
    for key, fold in of_key.items():
        fits |= dict.fromkeys(fold, Refit(**store.get(key)))
    return fits


def stroke_of(rows: Rows, row: int) -> tuple[float, float, bytes]:
    """A stroke of a `RefitJob`."""
    condition = rows[row].press.condition
    return condition.depth_mm, condition.tilt_deg, rows.pixels(row)


def _first_uncut(rows: Rows, group: Numbers) -> list[int]:
    """The rows of one cell that a fit uses."""
    return [int(row) for row in group[~rows.cut[group]][:PER_CELL]]
