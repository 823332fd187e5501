"""The run: read every press, fit to other cells, score everything. Finished work is never repeated.

Each result depends only on its inputs, so neither the order nor the place of work changes it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brushloop.calibrate.compare.place import KEYS, Alignment, Field, Pixels, Tone, brush_of, images_of, levels_of
from brushloop.calibrate.compare.score import similarity
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.captures import Pressed, grid_of
from brushloop.calibrate.fit.heldout import MAX_FOLDS, Refit, RefittedBezier, leave_out, refit_bezier, refits
from brushloop.calibrate.pool import Scheduler, finished
from brushloop.calibrate.presses import read_presses, too_thin, uncommanded
from brushloop.calibrate.scores import Row, Scores, similarities
from brushloop.calibrate.stats import others_of
from brushloop.calibrate.store import Arrays, key_of
from brushloop.calibrate.validate.models import (
    ANOTHER,
    BEZIER_LEFT_OUT,
    BEZIER_REFITTED,
    BRUSH_LEFT_OUT,
    FITTED_HELD_OUT,
    GENERATOR_HELD_OUT,
    HELD_OUT_NAMES,
    REPEATED,
    FittedSession,
    Model,
    held_out,
    in_order,
    known_models,
    tuned,
)
from brushloop.calibrate.validate.tuning import FOLDS, tuned_by_cell
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, unseen

COUNTS = (1, 2, 3, 5, 9, 15, 30, 60)
"""Numbers of fitted presses for which similarity is told."""
DRAWS = 2
"""Random draws to average, since a fit from few presses depends on which are drawn."""
MAX_SCORED, MIN_LEFT = 200, 5
"""Most and fewest other presses that such a fit is scored on."""
MM_BINARY = KEYS.index((Alignment.MM, Tone.BINARY))


@dataclass(frozen=True, slots=True)
class Options:
    """What is compared, and how."""

    models: tuple[str, ...] = ()
    """Names; all if empty."""
    view: Field = field(default_factory=Field)
    generators: tuple[Path, ...] = ()
    ablations: bool = False
    held_out: bool = True
    tune_steps: int = 0
    """Tuning steps of each generator on other cells; 0 means no tuning."""


class Refused(NamedTuple):
    """A press that was not compared, or not with one of the models, and why."""

    session_id: str
    stroke_id: str
    why: str


class Step(NamedTuple):
    """Scores, in percent, of a fit from this many presses on all other presses of the session."""

    session_id: str
    strokes: int
    model: str
    csim: float
    ssim: float
    n: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """Every score of a run."""

    sessions: Sequence[FittedSession]
    options: Options
    models: Mapping[str, Sequence[Model]]
    """Models of each session, by its name."""
    scores: Scores
    """Of every model of any session, then of the comparisons with presses."""
    refused: Sequence[Refused]
    steps: Sequence[Step] = ()
    """Similarity by number of fitted presses; empty without ablations."""


def validate_presses(
    sessions: Sequence[FittedSession], options: Options, scheduler: Scheduler, work: Path, progress: Progress = unseen
) -> Outcome:
    """Compare every model with every press. Tuned generators are kept in the folder `work`.

    Raises `CalibrationError` for an unknown model, or if two sessions have the same name.
    """
    models: dict[str, Sequence[Model]] = {}
    for session in sessions:
        name = session.header.session_id
        if name in models:
            raise CalibrationError(str(session.recording.path), f"{name} is given twice")
        models[name] = known_models(
            session, options.generators, options.view, ablations=options.ablations, chosen=options.models
        )
    refused: list[Refused] = []
    rows: list[Row] = []
    for session in sessions:
        name = session.header.session_id
        of_session = list(_rows(session, options.view, refused, scheduler, progress))
        every = in_order([*models[name], *_held_out(session, of_session, options, scheduler, work, progress)])
        models[name] = [model for model in every if not options.models or model.name in options.models]
        rows += of_session
    names = list(dict.fromkeys(model.name for model in in_order([m for group in models.values() for m in group])))
    for name in options.models:
        if name not in names:
            why = f"{name} needs a fit, or --tune: see `brushloop validate sessions --help`"
            raise CalibrationError("--model", why)
    scores = Scores(rows, (*names, ANOTHER, REPEATED))
    _score(scores, sessions, models, refused, scheduler, progress)
    steps: list[Step] = []
    for number, session in enumerate(sessions if options.ablations else ()):
        steps += _similarity_by_strokes(session, number, scores, options.view, scheduler)
    return Outcome(sessions, options, models, scores, refused, steps)


def _rows(
    session: FittedSession, view: Field, refused: list[Refused], scheduler: Scheduler, progress: Progress
) -> Iterator[Row]:
    """Yield the presses of a session that can be compared."""
    left_out: list[tuple[str, str]] = []
    for press in read_presses(session, view, left_out, uncommanded, too_thin, scheduler=scheduler, progress=progress):
        yield Row.of(press, session.header)
    refused += (Refused(session.header.session_id, *reason) for reason in left_out)


def _held_out(
    session: FittedSession, rows: Sequence[Row], options: Options, scheduler: Scheduler, work: Path, progress: Progress
) -> Iterator[Model]:
    """Yield the models fitted to the session without the cells that they predict."""
    names, view = options.models or HELD_OUT_NAMES, options.view
    if options.held_out and (FITTED_HELD_OUT in names or BEZIER_REFITTED in names):
        left_out = _left_out(rows, MAX_FOLDS)
        presses = _refitted(session, left_out, view, scheduler, progress)
        if presses:
            yield held_out(BRUSH_LEFT_OUT, presses, view)
        if left_out:
            beziers = {cell: _bezier(others, view) for fold, others in left_out for cell in fold}
            yield held_out(BEZIER_LEFT_OUT, beziers, view)
    if options.tune_steps and GENERATOR_HELD_OUT in names:
        left_out = _left_out(rows, FOLDS)
        presses = _refitted(session, left_out, view, scheduler, progress)
        for number, generator in enumerate(options.generators):
            folds = [(fold, presses.get(fold[0])) for fold, _ in left_out]
            files = tuned_by_cell(session, folds, generator, options.tune_steps, work, progress)
            if files:
                yield tuned(files, brush_of(session.header), view, number)


LeftOut = list[tuple[list[Condition], list[Pressed]]]
"""Cells that are left out together, and the presses of all others that a fit uses."""


def _left_out(rows: Sequence[Row], most: int) -> LeftOut:
    """At most so many groups of cells, with the uncut presses of the others; none for a single cell."""
    cells: dict[Condition, list[Pressed]] = {row.condition: [] for row in sorted(rows, key=lambda row: row.condition)}
    for row in rows:
        if not row.cut:
            cells[row.condition].append(_pressed(row))
    return leave_out(cells, most)


def _refitted(
    session: FittedSession, left_out: LeftOut, view: Field, scheduler: Scheduler, progress: Progress
) -> dict[Condition, FittedPress]:
    """The brush fitted without each cell; empty for a session that was not fitted."""
    if session.fit is None:
        return {}
    start, grid = session.fit.press(), grid_of(view)
    jobs = [Refit.of(others, grid, start.radius_mm, start.length_mm, start=start) for _, others in left_out]
    what = f"{session.header.session_id}: cells left out in turn"
    presses = refits(jobs, session.store, scheduler, what, progress)
    return {cell: press for (fold, _), press in zip(left_out, presses, strict=True) for cell in fold}


def _pressed(row: Row) -> Pressed:
    """The coverage of a row, as a fit uses it."""
    return Pressed(row.condition.depth_mm, row.condition.tilt_deg, row.coverage / 255.0)


def _bezier(strokes: Sequence[Pressed], view: Field) -> RefittedBezier | None:
    """A refitted Bezier; None if the cells are too few to fit a plane."""
    try:
        return refit_bezier(strokes, grid_of(view))
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class ScoreJob:
    """Compare a press with images."""

    press: Pixels
    """(len(KEYS), 128, 128)."""
    against: tuple[Pixels, ...]
    """For each comparison (n, len(KEYS), 128, 128), whose scores are averaged; n is 0 where there is nothing."""

    @property
    def key(self) -> str:
        """Key in the store of finished work."""
        return key_of("score", self.press, *self.against)


def score_job(job: ScoreJob) -> Arrays:
    """`values` (comparisons, KEYS, 2): CSIM and SSIM, NaN where there is nothing to compare with."""
    return {"values": np.array([similarities(job.press / 255.0, images / 255.0) for images in job.against])}


def _score(
    scores: Scores,
    sessions: Sequence[FittedSession],
    models: Mapping[str, Sequence[Model]],
    refused: list[Refused],
    scheduler: Scheduler,
    progress: Progress,
) -> None:
    """Fill the table: every press against every model, other presses of its cell, and the press that it repeats."""
    done = 0
    for session in sessions:
        of_session = models[session.header.session_id]
        columns = [scores.models.index(name) for name in (*(model.name for model in of_session), ANOTHER, REPEATED)]
        places: dict[str, list[int]] = {}
        jobs = _jobs(session.header.session_id, of_session, scores, refused, places)
        for key, arrays in finished(scheduler, session.store, score_job, jobs):
            for row in places[key]:
                scores.values[row, columns] = arrays["values"]
            done += 1
            progress("compared", done, len(scores.rows))


def _jobs(
    session: str, models: Sequence[Model], scores: Scores, refused: list[Refused], places: dict[str, list[int]]
) -> Iterator[tuple[str, ScoreJob]]:
    """Yield the key and the job of each press of a session, and note its row in `places`; equal presses share a key."""
    rows, originals = scores.rows, _originals(scores.rows)
    for cell in (cell for cell in scores.cells if rows[cell[0]].session == session):
        predictions = list(_predictions(models, [rows[k] for k in cell], refused))
        for number, k in enumerate(cell):
            others = [rows[cell[other]] for other in others_of(number, len(cell))]
            job = ScoreJob(rows[k].images, (*predictions, _stack(others), _stack(originals[k])))
            key = job.key
            places.setdefault(key, []).append(k)
            yield key, job


def _stack(rows: Sequence[Row]) -> Pixels:
    """(rows, KEYS, 128, 128)."""
    return np.array([row.images for row in rows], np.uint8)


def _predictions(models: Sequence[Model], cell: Sequence[Row], refused: list[Refused]) -> Iterator[Pixels]:
    """Yield the images that each model predicts for a cell; none, and a reason, where it predicts none."""
    for model in models:
        try:
            yield model.predict(cell[0].condition)[np.newaxis]
        except DomainError as error:
            yield _stack([])
            why = f"{model.name} does not predict it: {error}"
            refused += (Refused(row.session, row.stroke.stroke_id, why) for row in cell)


def _originals(rows: Sequence[Row]) -> list[list[Row]]:
    """For each row the one of another session that it repeats, if that session is given too."""
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        by_name.setdefault(row.stroke.stroke_id, []).append(row)
    named = [[of for of in by_name.get(row.stroke.again_of or "", []) if of.session != row.session] for row in rows]
    return [originals if len(originals) == 1 else [] for originals in named]


def _similarity_by_strokes(
    session: FittedSession, number: int, scores: Scores, view: Field, scheduler: Scheduler
) -> Iterator[Step]:
    """Yield scores of fits from few presses on others of the session; none for a session with too few presses."""
    name, brush, grid = session.header.session_id, brush_of(session.header), grid_of(view)
    trials = list(_trials(name, number, scores))
    fitted = [[_pressed(row) for row in few] for few, _ in trials]
    jobs = [Refit.of(few, grid, float(brush.radius_mm), float(brush.length_mm)) for few in fitted]
    presses = refits(jobs, session.store, scheduler, "fits from few strokes")
    values: dict[tuple[int, str], list[tuple[float, float]]] = {}
    for (_, others), few, press in zip(trials, fitted, presses, strict=True):
        for label, model in (("CCD-BSM", press), ("Bézier", _bezier(few, view))):
            if model is not None:
                values.setdefault((len(few), label), []).extend(_on_others(model, others, view))
    for (count, label), of_model in sorted(values.items()):
        csim, ssim = (round(float(value), 6) for value in 100.0 * np.mean(of_model, axis=0))
        yield Step(name, count, label, csim, ssim, len(of_model))


def _on_others(model: FittedPress | RefittedBezier, rows: Sequence[Row], view: Field) -> Iterator[tuple[float, float]]:
    """Yield CSIM and SSIM in millimetres, binary, of each row."""
    outlines = {at: model.outline(at.depth_mm, at.tilt_deg) for at in {row.condition for row in rows}}
    images = {at: levels_of(images_of(outline, 0.0, view))[MM_BINARY] / 255.0 for at, outline in outlines.items()}
    for row in rows:
        yield similarity(row.images[MM_BINARY] / 255.0, images[row.condition], Alignment.MM)


def _trials(name: str, number: int, scores: Scores) -> Iterator[tuple[list[Row], list[Row]]]:
    """Yield the presses to fit and those to score on, of session `number`."""
    rows = scores.rows
    cells = [[k for k in cell if rows[k].session == name and not rows[k].cut] for cell in scores.cells]
    for draw in range(DRAWS):
        rng = np.random.default_rng([draw, number])
        # Every cell once before any cell twice, as a person would choose.
        groups = [[int(k) for k in rng.permutation(cell)] for cell in cells if cell]
        groups = [groups[int(g)] for g in rng.permutation(len(groups))]
        order = [k for turn in itertools.zip_longest(*groups) for k in turn if k is not None]
        for count in COUNTS:
            left = order[count:]
            if len(left) >= MIN_LEFT:
                others = sorted(left[:: max(1, -(-len(left) // MAX_SCORED))])
                yield [rows[k] for k in order[:count]], [rows[k] for k in others]
