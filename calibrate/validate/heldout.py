"""Held-out fits: each cell is left out in turn, and CCD-BSM and a Bezier are refitted to the others.

A job carries its strokes and returns numbers, so that it can run on any machine and its result can be stored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibrate.compare.field import Field
from calibrate.compare.images import Pixels, brush_of, loop_pixels, unpack
from calibrate.fit.artefact import BrushFit
from calibrate.fit.captures import Grid, Pressed, grid_of, inked_rows
from calibrate.fit.fit import refit
from calibrate.fit.heldout import BEZIER_SIZES, RefittedBezier, refit_bezier
from calibrate.validate.pool import Scheduler
from calibrate.validate.rows import Cell, Numbers, Rows
from calibrate.validate.sources import LoadedSession
from calibrate.validate.store import VERSION, Store
from model.fitted import MODES, NAMES, TERMS, FittedPress
from model.plane import Plane
from sessions.progress import Progress

MAX_FOLDS = 15
"""Most folds: the paper's grid leaves out one cell at a time, a larger grid several."""
PER_CELL = 3
"""Presses of each other cell that a fit uses; more did not change it."""
MAX_STROKES = 60


@dataclass(frozen=True, slots=True)
class RefitJob:
    """Fit the brush and a Bezier to these presses."""

    strokes: tuple[tuple[float, float, bytes], ...]
    """H, alpha and `Press.pixels`, whose last image is the coverage."""
    radius_mm: float
    length_mm: float
    start: tuple[float, ...] | None
    """Parameters of the session's fit; None fits no CCD-BSM."""
    view: Field

    @property
    def key(self) -> str:
        """Hash of everything that determines the result."""
        digest = hashlib.sha256(
            f"refit {VERSION} {self.radius_mm} {self.length_mm} {self.start} {self.view} {len(self.strokes)}".encode()
        )
        for height, tilt, pixels in self.strokes:
            digest.update(f"{height} {tilt} ".encode() + hashlib.sha256(pixels).digest())
        return digest.hexdigest()


def start_of(fit: BrushFit) -> tuple[float, ...]:
    """Initial values of a refit: those of the whole session."""
    return tuple(fit.parameters[name].value for name in NAMES)


def folds(cells: Sequence[Cell], most: int = MAX_FOLDS) -> list[list[Cell]]:
    """Groups of cells that are left out together; none if there is only one cell."""
    ordered = sorted(set(cells))
    count = min(len(ordered), most)
    return [ordered[k::count] for k in range(count)] if len(ordered) > 1 else []


def refit_job(job: RefitJob) -> dict[str, Any]:
    """Fit `fitted` (values, edges) and `bezier` (coefficients), each None if there are too few strokes for it."""
    strokes, grid = cropped(job)
    out: dict[str, Any] = {"fitted": None}
    if job.start is not None:
        whole = FittedPress(job.radius_mm, job.length_mm, np.array(job.start))
        out["fitted"] = press_body(refit(whole, strokes, grid))
    return out | {"bezier": bezier_body(strokes, grid)}


def press_body(press: FittedPress) -> dict[str, Any]:
    """A fitted brush as plain data."""
    return {"values": press.values.tolist(), "edges": press.edges.ravel().tolist(), "ends": press.ends.ravel().tolist()}


def bezier_body(strokes: Sequence[Pressed], grid: Grid) -> list[float] | None:
    """A refitted Bezier as plain data; None if the cells are too few to fit a plane."""
    try:
        coefficients = refit_bezier(strokes, grid).plane.coefficients
    except ValueError:
        return None
    return [float(value) for value in coefficients.ravel()]


def cropped(job: RefitJob) -> tuple[list[Pressed], Grid]:
    """Crop the strokes and their grid to the inked rows and 2 mm more, as `brushloop fit` does."""
    inks = [unpack(pixels)[-1].astype(np.float64) / 255.0 for _, _, pixels in job.strokes]
    rows, grid = inked_rows(inks, job.view), grid_of(job.view)
    pressed = [Pressed(h, a, ink[rows]) for (h, a, _), ink in zip(job.strokes, inks, strict=True)]
    return pressed, Grid(grid.x_mm, grid.y_mm[rows])


def fitted_press(body: dict[str, Any], radius_mm: float, length_mm: float) -> FittedPress:
    """The fitted brush in the result of a finished job."""
    edges = np.array(body["edges"]).reshape(2, MODES, TERMS)
    return FittedPress(radius_mm, length_mm, np.array(body["values"]), edges, np.array(body["ends"]).reshape(2, TERMS))


def bezier_pixels(coefficients: Sequence[float], height_mm: float, tilt_deg: float, view: Field) -> Pixels:
    """Images of a refitted Bezier, (len(KEYS), 128, 128)."""
    plane = Plane(BEZIER_SIZES, np.reshape(coefficients, (len(BEZIER_SIZES), 3)))
    return loop_pixels(RefittedBezier(plane).outline(height_mm, tilt_deg), view)


def refits_by_cell(
    session: LoadedSession,
    number: int,
    rows: Rows,
    view: Field,
    scheduler: Scheduler,
    store: Store,
    progress: Progress,
    most_folds: int = MAX_FOLDS,
) -> dict[Cell, dict[str, Any]]:
    """Refit for each cell of session `number` to uncut presses of its other cells; return the results by cell."""
    cells = {cell: _first_uncut(rows, group) for session_of, cell, group in rows.groups() if session_of == number}
    brush = brush_of(session.header)
    start = start_of(session.fit) if session.fit is not None else None
    fits: dict[Cell, dict[str, Any]] = {}
    left = folds(list(cells), most_folds)
    jobs: list[tuple[str, RefitJob]] = []
    of_key: dict[str, list[Cell]] = {}
    for fold in left:
        alone = set(fold)
        others = [row for cell, group in cells.items() if cell not in alone for row in group]
        others = others[:: max(1, -(-len(others) // MAX_STROKES))]
        if not others:
            continue
        strokes = tuple((*rows.cell(row), rows.pixels(row)) for row in others)
        job = RefitJob(strokes, float(brush.radius_mm), float(brush.length_mm), start, view)
        of_key[job.key] = fold
        if job.key not in store:
            jobs.append((job.key, job))
    done = len(of_key) - len(jobs)
    for key, found in scheduler.run(refit_job, iter(jobs)):
        store.put(key, found)
        done += 1
        progress(f"{session.header.session_id}: cells left out in turn", done, len(of_key))
    for key, fold in of_key.items():
        fits |= dict.fromkeys(fold, store.get(key))
    return fits


def _first_uncut(rows: Rows, group: Numbers) -> list[int]:
    """The rows of one cell that a fit uses."""
    return [int(row) for row in group[~rows.index["cut"][group]][:PER_CELL]]
