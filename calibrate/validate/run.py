"""The run: prepare every capture, fit to other cells, score everything. Finished work is never repeated.

Captures stream from the recording through the workers into the store, and so do their scores, which are then held in
memory. Each result depends only on its inputs, so neither the order nor the place of work changes it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from brushloop.calibrate.compare.paper import ROBOT_WRITING
from brushloop.calibrate.compare.place import KEYS, Field, brush_of, pack
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.pool import Scheduler
from brushloop.calibrate.scores import Score, Scores
from brushloop.calibrate.stats import others_of
from brushloop.calibrate.validate import candidates as who
from brushloop.calibrate.validate.candidates import Candidate, Generator
from brushloop.calibrate.validate.heldout import refits_by_cell
from brushloop.calibrate.validate.jobs import ABSENT, ScoreJob, prepared, score_job
from brushloop.calibrate.validate.rows import Numbers, Row, Rows
from brushloop.calibrate.validate.sources import LoadedSession
from brushloop.calibrate.validate.store import Store
from brushloop.calibrate.validate.tuning import FOLDS, tuned_by_cell
from brushloop.model.ccdbsm import DomainError
from brushloop.sessions.terminal import Progress

CHUNK = 16
"""Most strokes in one job of scores; all are of one condition in one session."""
ANOTHER = "another press"
"""A capture predicted by other captures of its cell, averaged: how well one press predicts another."""
REPEATED = ROBOT_WRITING
"""A press compared with the stroke of another session that it repeats: the third row of the paper's Table 1."""


@dataclass(frozen=True, slots=True)
class Options:
    """What is compared, and how."""

    models: tuple[str, ...] = ()
    view: Field = field(default_factory=Field)
    generators: tuple[Generator, ...] = ()
    ablations: bool = False
    held_out: bool = True
    tune_steps: int = 0
    """Tuning steps of each generator on other cells; 0 means no tuning."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Every score of a run."""

    sessions: list[LoadedSession]
    options: Options
    candidates: list[list[Candidate]]
    """Candidates of each session."""
    rows: Rows
    """Compared strokes, by session and order of capture."""
    scores: Scores
    """Of every candidate of any session, then of the comparisons with presses."""
    refused: list[tuple[str, str, str]]
    """(session, stroke, reason) of strokes that could not be used, or that one of the models does not predict."""
    store: Store

    def every_score(self) -> Iterator[Score]:
        """The scores by session, order of capture and model; those that are missing are left out."""
        for k, row in enumerate(self.rows):
            session, press = self.sessions[row.session], row.press
            reached_mm = session.reached_mm.get(press.stroke_id)
            about = (session.header.session_id, press.stroke_id, press.condition, reached_mm)
            for model, values in zip(self.scores.models, self.scores.of_stroke(k), strict=True):
                for key, (csim, ssim) in zip(KEYS, values.tolist(), strict=True):
                    if math.isfinite(csim):
                        yield Score(*about, model, *key, csim, ssim)


def validate_presses(
    sessions: list[LoadedSession], options: Options, scheduler: Scheduler, work: Path, progress: Progress
) -> Outcome:
    """Compare every candidate with every press. The caller closes `Outcome.store`.

    Raises `CalibrationError` for an unknown model, or if two sessions have the same name.
    """
    idents = [session.header.session_id for session in sessions]
    for k, ident in enumerate(idents):
        if ident in idents[:k]:
            raise CalibrationError(str(sessions[k].recording.path), f"{ident} is given twice")
    store = Store(work / "work.sqlite")
    try:
        return _validate(sessions, options, scheduler, store, work, progress)
    except BaseException:
        store.close()
        raise


def _validate(
    sessions: list[LoadedSession], options: Options, scheduler: Scheduler, store: Store, work: Path, progress: Progress
) -> Outcome:
    # Models that the user names are checked before hours of work begin; otherwise they are loaded later.
    known = _known(sessions, options) if options.models or options.generators else []
    refused: list[tuple[str, str, str]] = []

    def used() -> Iterator[Row]:
        for number, session in enumerate(sessions):
            for key, press in prepared(session, options.view, scheduler, store, progress):
                if press.refused:
                    refused.append((session.header.session_id, press.stroke_id, press.refused))
                else:
                    yield Row(number, key, press)

    rows = Rows(store, used())
    known = known or _known(sessions, options)
    candidates: list[list[Candidate]] = []
    for number, session in enumerate(sessions):
        held_out = _held_out(session, number, rows, options, scheduler, store, work, progress)
        candidates.append(
            [one for one in _ordered([*known[number], *held_out]) if not options.models or one.name in options.models]
        )
    for name in options.models:
        if not any(one.name == name for group in candidates for one in group):
            raise CalibrationError(
                "--model", f"{name} needs a fit, or --tune: see `brushloop validate sessions --help`"
            )
    names = [*_ordered_names(candidates), ANOTHER, REPEATED]
    columns = [
        np.array([names.index(name) for name in (*(one.name for one in group), ANOTHER, REPEATED)], np.int64)
        for group in candidates
    ]
    scores, places = Scores(len(rows), names), dict[str, list[Numbers]]()
    done = 0

    def put(key: str) -> None:
        nonlocal done
        body = store.get(key)
        values = np.frombuffer(body["values"]).reshape(body["shape"])
        for chunk in places.pop(key):
            scores.put(chunk, columns[rows[int(chunk[0])].session], values)
            done += len(chunk)
        progress("compared", done, len(rows))

    def waiting() -> Iterator[tuple[str, ScoreJob]]:
        for chunk, job in _score_jobs(sessions, candidates, rows, refused):
            key = job.key
            places.setdefault(key, []).append(chunk)
            if key in store:
                put(key)
            elif len(places[key]) == 1:
                yield key, job

    for key, found in scheduler.run(score_job, waiting()):
        store.put(key, {"shape": list(found.shape), "values": found.tobytes()})
        put(key)
    return Outcome(sessions, options, candidates, rows, scores, refused, store)


def _known(sessions: list[LoadedSession], options: Options) -> list[list[Candidate]]:
    """The candidates of each session that need no held-out fit. Raises `CalibrationError` for an unknown --model."""
    view = options.view
    known = [
        [*who.generators(one, options.generators, view), *who.closed_forms(one, view, ablations=options.ablations)]
        for one in sessions
    ]
    every = (*dict.fromkeys(one.name for group in map(_ordered, known) for one in group), *who.HELD_OUT_NAMES)
    for name in options.models:
        if name not in every:
            raise CalibrationError("--model", f"{name!r} is not one of: {', '.join(every)}")
    return known


def _held_out(
    session: LoadedSession,
    number: int,
    rows: Rows,
    options: Options,
    scheduler: Scheduler,
    store: Store,
    work: Path,
    progress: Progress,
) -> Iterator[Candidate]:
    """Yield the candidates fitted to the session without the cells they predict."""
    names = options.models or who.HELD_OUT_NAMES
    brush, view = brush_of(session.header), options.view
    if options.held_out and (who.FITTED_HELD_OUT in names or who.BEZIER_REFITTED in names):
        fits = refits_by_cell(session, number, rows, view, scheduler, store, progress)
        if fits:
            yield from who.held_out(fits, brush, view, fitted=session.fit is not None)
    if options.tune_steps and who.GENERATOR_HELD_OUT in names:
        fits = refits_by_cell(session, number, rows, view, scheduler, store, progress, FOLDS)
        for number, generator in enumerate(options.generators):
            files = tuned_by_cell(session, fits, generator, options.tune_steps, work, progress)
            if files:
                yield who.tuned(files, brush, view, number)


def _score_jobs(
    sessions: list[LoadedSession],
    candidates: list[list[Candidate]],
    rows: Rows,
    refused: list[tuple[str, str, str]],
) -> Iterator[tuple[Numbers, ScoreJob]]:
    """Yield (rows, job), in the order of `Rows.groups`."""
    originals = _originals(rows) if len(sessions) > 1 else {}
    for session, condition, group in rows.groups:
        predictions: list[bytes] = []
        for one in candidates[session]:
            try:
                predictions.append(pack(one.predict(condition)))
            except DomainError as error:
                predictions.append(ABSENT)
                why = f"{one.name} does not predict it: {error}"
                refused.extend((sessions[session].header.session_id, rows[int(k)].press.stroke_id, why) for k in group)
        for start in range(0, len(group), CHUNK):
            chunk = group[start : start + CHUNK]
            theirs = [[int(group[k]) for k in others_of(start + n, len(group))] for n in range(len(chunk))]
            others = sorted({k for mine in theirs for k in mine})
            job = ScoreJob(
                tuple(rows.pixels(k) for k in map(int, chunk)),
                tuple(predictions),
                tuple(rows.pixels(k) for k in others),
                tuple(tuple(others.index(k) for k in mine) for mine in theirs),
                tuple(rows.pixels(originals[k]) if k in originals else ABSENT for k in map(int, chunk)),
            )
            yield chunk, job


def _originals(rows: Rows) -> dict[int, int]:
    """Map a row to the row of another session that it repeats, if that session is given too."""
    again = {k: row.press.again_of for k, row in enumerate(rows) if row.press.again_of}
    named = set(again.values())
    by_name: dict[str, list[int]] = {}
    for k, row in enumerate(rows if named else ()):
        if row.press.stroke_id in named:
            by_name.setdefault(row.press.stroke_id, []).append(k)
    session = rows.session
    found: dict[int, int] = {}
    for k, name in again.items():
        of = [n for n in by_name.get(name, []) if session[n] != session[k]]
        if len(of) == 1:
            found[k] = of[0]
    return found


def _ordered_names(candidates: list[list[Candidate]]) -> list[str]:
    return list(dict.fromkeys(one.name for one in _ordered([one for group in candidates for one in group])))


def _ordered(found: list[Candidate]) -> list[Candidate]:
    """Sort in the order of the paper's tables, calibrated next to uncalibrated, all others last."""
    first = [
        "ccd-bsmg",
        who.GENERATOR_HELD_OUT,
        "ccd-bsm",
        who.FITTED,
        who.FITTED_HELD_OUT,
        "bezier",
        who.BEZIER_REFITTED,
    ]
    first += ["ellipse", "line", "circle"]

    def place(one: Candidate) -> tuple[int, int]:
        stem = one.name if one.name in first else "ccd-bsmg" if one.name.startswith("ccd-bsmg-") else ""
        return (first.index(stem), 0) if stem else (len(first), 0)

    return sorted(found, key=place)
