"""The run: read every press, fit to other cells, score everything. Finished work is never repeated.

Each result depends only on its inputs, so neither the order nor the place of work changes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from brushloop.calibrate.compare.place import (
    KEYS,
    Alignment,
    Field,
    Tone,
    brush_of,
    images_of,
    levels_of,
    pack,
    to_pixels,
    unpack,
)
from brushloop.calibrate.compare.score import similarity
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.captures import Pressed, grid_of
from brushloop.calibrate.fit.heldout import MAX_FOLDS, Refit, RefittedBezier, folds, refit_bezier, refits, without
from brushloop.calibrate.pool import Scheduler, finished
from brushloop.calibrate.presses import read_presses, too_thin, uncommanded
from brushloop.calibrate.scores import Numbers, Row, Scores, Values
from brushloop.calibrate.stats import others_of
from brushloop.calibrate.store import Arrays, key_of
from brushloop.calibrate.validate.inputs import FittedSession
from brushloop.calibrate.validate.models import (
    ANOTHER,
    BEZIER_REFITTED,
    FITTED_HELD_OUT,
    GENERATOR_HELD_OUT,
    HELD_OUT_NAMES,
    REPEATED,
    Model,
    Refitted,
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
    by_name = {session.header.session_id: session for session in sessions}
    if len(by_name) < len(sessions):
        names = [session.header.session_id for session in sessions]
        twice = next(k for k, name in enumerate(names) if name in names[:k])
        raise CalibrationError(str(sessions[twice].recording.path), f"{names[twice]} is given twice")
    models = {
        name: known_models(
            session, options.generators, options.view, ablations=options.ablations, chosen=options.models
        )
        for name, session in by_name.items()
    }
    refused: list[Refused] = []
    rows = [row for session in sessions for row in _rows(session, options.view, refused, scheduler, progress)]
    for name, session in by_name.items():
        mine = [row for row in rows if row.session == name]
        every = in_order([*models[name], *_held_out(session, mine, options, scheduler, work, progress)])
        models[name] = [model for model in every if not options.models or model.name in options.models]
    every_name = list(dict.fromkeys(model.name for model in in_order([m for group in models.values() for m in group])))
    for name in options.models:
        if name not in every_name:
            why = f"{name} needs a fit, or --tune: see `brushloop validate sessions --help`"
            raise CalibrationError("--model", why)
    scores = Scores(rows, (*every_name, ANOTHER, REPEATED))
    _score(scores, by_name, models, refused, scheduler, progress)
    outcome = Outcome(sessions, options, models, scores, refused)
    if not options.ablations:
        return outcome
    steps = [step for session in sessions for step in _similarity_by_strokes(session, scores, options.view, scheduler)]
    return Outcome(sessions, options, models, scores, refused, steps)


def _rows(
    session: FittedSession, view: Field, refused: list[Refused], scheduler: Scheduler, progress: Progress
) -> Iterator[Row]:
    """Yield the presses of a session that can be compared."""
    name, left_out = session.header.session_id, list[tuple[str, str]]()
    for press in read_presses(session, view, left_out, uncommanded, too_thin, scheduler=scheduler, progress=progress):
        packed = pack(np.stack([to_pixels(image) for image in (*press.images.values(), press.coverage)]))
        yield Row(name, press.stroke, press.condition, press.measured, press.cut, packed)
    refused += (Refused(name, *reason) for reason in left_out)


def _held_out(
    session: FittedSession,
    rows: Sequence[Row],
    options: Options,
    scheduler: Scheduler,
    work: Path,
    progress: Progress,
) -> Iterator[Model]:
    """Yield the models fitted to the session without the cells that they predict."""
    names, view, brush = options.models or HELD_OUT_NAMES, options.view, brush_of(session.header)
    if options.held_out and (FITTED_HELD_OUT in names or BEZIER_REFITTED in names):
        fits = _refitted(session, rows, view, MAX_FOLDS, scheduler, progress)
        if fits:
            yield from held_out(fits, view, fitted=session.fit is not None)
    if options.tune_steps and GENERATOR_HELD_OUT in names:
        fits = _refitted(session, rows, view, FOLDS, scheduler, progress)
        for number, generator in enumerate(options.generators):
            presses = {cell: refitted.press for cell, refitted in fits.items()}
            files = tuned_by_cell(session, presses, generator, options.tune_steps, work, progress)
            if files:
                yield tuned(files, brush, view, number)


def _refitted(
    session: FittedSession, rows: Sequence[Row], view: Field, most: int, scheduler: Scheduler, progress: Progress
) -> dict[Condition, Refitted]:
    """Fits to the uncut presses of all other cells, by cell; CCD-BSM only for a session that was fitted."""
    cells: dict[Condition, list[Pressed]] = {row.condition: [] for row in sorted(rows, key=lambda row: row.condition)}
    for row in rows:
        if not row.cut:
            cells[row.condition].append(_pressed(row))
    left = [(fold, others) for fold in folds(list(cells), most) if (others := without(cells, fold))]
    brush, grid = brush_of(session.header), grid_of(view)
    presses: Sequence[FittedPress | None] = [None] * len(left)
    if session.fit is not None:
        jobs = [Refit.of(others, grid, float(brush.radius_mm), float(brush.length_mm)) for _, others in left]
        what = f"{session.header.session_id}: cells left out in turn"
        presses = refits(jobs, session.store, scheduler, what, progress)
    return {
        cell: Refitted(press, _bezier(others, view))
        for (fold, others), press in zip(left, presses, strict=True)
        for cell in fold
    }


def _pressed(row: Row) -> Pressed:
    """The coverage of a row, as a fit uses it."""
    coverage = unpack(row.packed)[len(KEYS)] / 255.0
    return Pressed(row.condition.depth_mm, row.condition.tilt_deg, coverage)


def _bezier(strokes: Sequence[Pressed], view: Field) -> RefittedBezier | None:
    """A refitted Bezier; None if the cells are too few to fit a plane."""
    try:
        return refit_bezier(strokes, grid_of(view))
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class ScoreJob:
    """Compare a press with images; each of these is `pack` of (at least len(KEYS), 128, 128)."""

    press: bytes
    against: tuple[tuple[bytes, ...], ...]
    """For each comparison the images whose scores are averaged; none where there is nothing to compare with."""

    @property
    def key(self) -> str:
        """Key in the store of finished work."""
        return key_of("score", self.press, self.against)


def score_job(job: ScoreJob) -> Arrays:
    """`values` (comparisons, KEYS, 2): CSIM and SSIM, NaN where there is nothing to compare with."""
    captured = unpack(job.press) / 255.0
    nothing = np.full((len(KEYS), 2), np.nan)
    means = [
        np.mean([_similarities(captured, unpack(image) / 255.0) for image in images], axis=0) if images else nothing
        for images in job.against
    ]
    return {"values": np.array(means).reshape(-1, len(KEYS), 2)}


def _similarities(captured: Values, other: Values) -> Values:
    """(KEYS, 2) CSIM and SSIM; NaN where the other image is blank."""
    return np.array(
        [
            similarity(captured[k], other[k], alignment) if other[k].any() else (np.nan, np.nan)
            for k, (alignment, _) in enumerate(KEYS)
        ]
    )


def _score(
    scores: Scores,
    sessions: Mapping[str, FittedSession],
    models: Mapping[str, Sequence[Model]],
    refused: list[Refused],
    scheduler: Scheduler,
    progress: Progress,
) -> None:
    """Fill the table: every press against every model, other presses of its cell, and the press that it repeats."""
    originals, done = _originals(scores.rows), 0
    for name, session in sessions.items():
        columns = [scores.models.index(model.name) for model in models[name]]
        columns += [scores.models.index(kind) for kind in (ANOTHER, REPEATED)]
        jobs: dict[str, ScoreJob] = {}
        places: dict[str, list[int]] = {}
        for cell in scores.cells:
            if scores.rows[int(cell[0])].session != name:
                continue
            predictions = list(_predictions(models[name], scores.rows, cell, refused))
            for number, row in enumerate(map(int, cell)):
                others = tuple(scores.rows[int(cell[k])].packed for k in others_of(number, len(cell)))
                original = (scores.rows[originals[row]].packed,) if row in originals else ()
                job = ScoreJob(scores.rows[row].packed, (*predictions, others, original))
                jobs[job.key] = job
                places.setdefault(job.key, []).append(row)
        for key, arrays in finished(scheduler, session.store, score_job, jobs.items()):
            for row in places[key]:
                scores.values[row, columns] = arrays["values"]
            done += len(places[key])
            progress("compared", done, len(scores.rows))


def _predictions(
    models: Sequence[Model], rows: Sequence[Row], cell: Numbers, refused: list[Refused]
) -> Iterator[tuple[bytes, ...]]:
    """Yield the image that each model predicts for a cell; none, and a reason, where it predicts none."""
    for model in models:
        try:
            yield (pack(model.predict(rows[int(cell[0])].condition)),)
        except DomainError as error:
            yield ()
            why = f"{model.name} does not predict it: {error}"
            refused += (Refused(rows[int(k)].session, rows[int(k)].stroke.stroke_id, why) for k in cell)


def _originals(rows: Sequence[Row]) -> dict[int, int]:
    """Map a row to the row of another session that it repeats, if that session is given too."""
    by_name: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        by_name.setdefault(row.stroke.stroke_id, []).append(k)
    found: dict[int, int] = {}
    for k, row in enumerate(rows):
        named = by_name.get(row.stroke.again_of or "", [])
        others = [n for n in named if rows[n].session != row.session]
        if len(others) == 1:
            found[k] = others[0]
    return found


def _similarity_by_strokes(
    session: FittedSession, scores: Scores, view: Field, scheduler: Scheduler, progress: Progress = unseen
) -> Iterator[Step]:
    """Yield scores of fits from few presses on others of the session; none for a session with too few presses."""
    name, brush = session.header.session_id, brush_of(session.header)
    number = list(dict.fromkeys(row.session for row in scores.rows)).index(name)
    trials = list(_trials(name, number, scores))
    rows = scores.rows
    fitted = [[_pressed(rows[k]) for k in chosen] for chosen, _ in trials]
    jobs = [Refit.of(each, grid_of(view), float(brush.radius_mm), float(brush.length_mm)) for each in fitted]
    presses = refits(jobs, session.store, scheduler, "fits from few strokes", progress)
    values: dict[tuple[int, str], list[Values]] = {}
    for (chosen, others), few, press in zip(trials, fitted, presses, strict=True):
        for label, model in (("CCD-BSM", press), ("Bézier", _bezier(few, view))):
            if model is not None:
                values.setdefault((len(chosen), label), []).extend(
                    _on_others(model, [rows[k] for k in others], session, view, scheduler)
                )
    for (count, label), of_model in sorted(values.items()):
        csim, ssim = (round(float(value), 6) for value in 100.0 * np.mean(of_model, axis=0))
        yield Step(name, count, label, csim, ssim, len(of_model))


def _on_others(
    model: FittedPress | RefittedBezier, rows: Sequence[Row], session: FittedSession, view: Field, scheduler: Scheduler
) -> list[Values]:
    """(2,) CSIM and SSIM in millimetres, binary, of each row."""
    cells = {row.condition for row in rows}
    images = {at: pack(levels_of(images_of(model.outline(at.depth_mm, at.tilt_deg), 0.0, view))) for at in cells}
    jobs = [ScoreJob(row.packed, ((images[row.condition],),)) for row in rows]
    unique = {job.key: job for job in jobs}
    results = dict(finished(scheduler, session.store, score_job, unique.items()))
    return [results[job.key]["values"][0, MM_BINARY] for job in jobs]


def _trials(name: str, number: int, scores: Scores) -> Iterator[tuple[list[int], list[int]]]:
    """Yield the rows to fit and those to score on, of session `number`."""
    rows = scores.rows
    cells = [[k for k in map(int, cell) if rows[k].session == name and not rows[k].cut] for cell in scores.cells]
    for draw in range(DRAWS):
        rng = np.random.default_rng([draw, number])
        # Every cell once before any cell twice, as a person would choose.
        groups = [[int(k) for k in rng.permutation(cell)] for cell in cells if cell]
        groups = [groups[int(g)] for g in rng.permutation(len(groups))]
        deepest = max(map(len, groups), default=0)
        order = [group[depth] for depth in range(deepest) for group in groups if depth < len(group)]
        for count in COUNTS:
            left = order[count:]
            if len(left) >= MIN_LEFT:
                yield order[:count], sorted(left[:: max(1, -(-len(left) // MAX_SCORED))])
