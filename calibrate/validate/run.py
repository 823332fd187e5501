"""The run: read every press, fit to other cells, score everything. Finished work is never repeated.

Each result depends only on its inputs, so neither the order nor the place of work changes it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.commands import ValidateRequest
from brushloop.calibrate.compare import (
    KEYS,
    Alignment,
    Pixels,
    Tone,
    images_of,
    similarity,
)
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.heldout import Refit, leave_out, refits
from brushloop.calibrate.presses import Press, for_fit, read_presses, too_thin, uncommanded
from brushloop.calibrate.scores import Scores, similarities
from brushloop.calibrate.stats import others_of
from brushloop.calibrate.validate.models import (
    ANOTHER,
    BEZIER_LEFT_OUT,
    BEZIER_REFITTED,
    BRUSH_LEFT_OUT,
    FITTED_HELD_OUT,
    FittedSession,
    Model,
    held_out,
    in_order,
    known_models,
    predicted,
)
from brushloop.calibrate.work import Arrays, Scheduler, key_of
from brushloop.model.presses import Draw, refit_bezier
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, counted, unseen

COUNTS = (1, 2, 3, 5, 9, 15, 30, 60)
"""Numbers of fitted presses for which similarity is told."""
DRAWS = 2
"""Random draws to average, since a fit from few presses depends on which are drawn."""
MAX_SCORED, MIN_LEFT = 200, 5
"""Most and fewest other presses that such a fit is scored on."""
MM_BINARY = KEYS.index((Alignment.MM, Tone.BINARY))


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
    """Every score of a run, and the models that were compared."""

    sessions: Sequence[FittedSession]
    request: ValidateRequest
    models: Mapping[str, Sequence[Model]]
    """Models of each session, by its name."""
    scores: Scores
    """Of every model of any session, then of the comparisons with presses."""
    refused: Sequence[Refused]
    steps: Sequence[Step] = ()
    """Similarity by number of fitted presses; empty without ablations."""
    drawn: dict[tuple[str, Condition], dict[str, Pixels]] = field(
        default_factory=dict[tuple[str, Condition], dict[str, Pixels]]
    )
    """What was asked for before, by session and condition: a page shows a few of them several times."""

    def predicted(self, press: Press) -> dict[str, Pixels]:
        """(len(KEYS), 128, 128) of a press by the models that predict it."""
        cell = press.session, press.condition
        if cell not in self.drawn:
            [store] = (session.store for session in self.sessions if session.header.session_id == press.session)
            self.drawn[cell] = predicted(self.models[press.session], press.condition, store)[0]
        return self.drawn[cell]


def validate_presses(
    sessions: Sequence[FittedSession], request: ValidateRequest, scheduler: Scheduler, progress: Progress = unseen
) -> Outcome:
    """Compare every model with every press.

    Raises `CalibrationError` for an unknown model, or if two sessions have the same name.
    """
    models: dict[str, Sequence[Model]] = {}
    for session in sessions:
        known = known_models(session, request.generators, ablations=request.ablations)
        models[session.header.session_id] = known
    if len(models) < len(sessions):
        raise CalibrationError(sessions[-1].header.session_id, "two sessions have this name")
    possible = [*(model.name for known in models.values() for model in known), BEZIER_REFITTED]
    possible += [FITTED_HELD_OUT] if any(session.fit for session in sessions) else []
    for name in request.models:
        if name not in possible:
            names = ", ".join(dict.fromkeys(possible))
            raise CalibrationError("--model", f"{name!r} is not one of: {names}; some need a fit or --generator")
    refused: list[Refused] = []
    presses: list[Press] = []
    for session in sessions:
        name, left_out = session.header.session_id, list[tuple[str, str]]()
        reasons = uncommanded, too_thin
        of_session = list(read_presses(session, left_out, *reasons, scheduler=scheduler, progress=progress))
        refused += (Refused(name, *reason) for reason in left_out)
        every = in_order([*models[name], *_held_out(session, of_session, request, scheduler, progress)])
        models[name] = [model for model in every if not request.models or model.name in request.models]
        presses += of_session
    names = list(dict.fromkeys(model.name for model in in_order([m for group in models.values() for m in group])))
    scores = Scores(presses, (*names, ANOTHER))
    for session in sessions:
        _score(scores, session, models[session.header.session_id], refused, scheduler, progress)
    steps: list[Step] = []
    for number, session in enumerate(sessions if request.ablations else ()):
        steps += _similarity_by_strokes(session, number, scores, scheduler)
    return Outcome(sessions, request, models, scores, refused, steps)


def _held_out(
    session: FittedSession, presses: Sequence[Press], request: ValidateRequest, scheduler: Scheduler, progress: Progress
) -> Iterator[Model]:
    """Yield the models fitted to the session without the cells that they predict."""
    wanted = request.models or (FITTED_HELD_OUT, BEZIER_REFITTED)
    if not request.held_out or not {FITTED_HELD_OUT, BEZIER_REFITTED} & {*wanted}:
        return
    whole = for_fit([press for press in presses if not press.cut], session.header)
    cells = {(press.condition.depth_mm, press.condition.tilt_deg): list[int]() for press in presses} | whole.cells
    left_out = [(fold, whole.pick(others)) for fold, others in leave_out(cells)]
    if not left_out:
        return
    if session.fit is not None:
        start = session.fit.press()
        size = {"radius_mm": start.radius_mm, "length_mm": start.length_mm}
        jobs = [Refit(replace(others, **size), start=start.values) for _, others in left_out]
        what = f"{session.header.session_id}: cells left out in turn"
        fits = refits(jobs, session.store, scheduler, what, progress)
        brushes = {cell: fit.outline for (fold, _), fit in zip(left_out, fits, strict=True) for cell in fold}
        yield held_out(BRUSH_LEFT_OUT, brushes)
    yield held_out(BEZIER_LEFT_OUT, {cell: refit_bezier(others) for fold, others in left_out for cell in fold})


ScoreJob = tuple[Pixels, tuple[Sequence[Pixels], ...]]
"""A press (len(KEYS), 128, 128), and the images of each comparison, of that shape, whose scores are averaged."""


def score_job(job: ScoreJob) -> Arrays:
    """`values` (comparisons, KEYS, 2): CSIM and SSIM, NaN where there is nothing to compare with."""
    return {"values": similarities(*job)}


def _score(
    scores: Scores,
    session: FittedSession,
    models: Sequence[Model],
    refused: list[Refused],
    scheduler: Scheduler,
    progress: Progress,
) -> None:
    """Fill the table for one session: every press against every model, and against other presses of its cell."""
    columns = [scores.models.index(name) for name in (*(model.name for model in models), ANOTHER)]
    cells = [cell for cell in scores.cells if scores.presses[cell[0]].session == session.header.session_id]
    numbers: dict[str, list[int]] = {}
    """Numbers of presses by the key of their job: equal presses share one."""

    def jobs() -> Iterator[tuple[str, ScoreJob]]:
        for cell in cells:
            presses = [scores.presses[k] for k in cell]
            images, reasons = predicted(models, presses[0].condition, session.store)
            for why in reasons.values():
                refused.extend(Refused(press.session, press.stroke.stroke_id, why) for press in presses)
            predictions = [[images[model.name]] if model.name in images else [] for model in models]
            for number, press in enumerate(presses):
                others = [presses[other].images for other in others_of(number, len(cell))]
                compared = (*predictions, others)
                key = key_of("score", press.images, *map(len, compared), *itertools.chain.from_iterable(compared))
                numbers.setdefault(key, []).append(cell[number])
                yield key, (press.images, compared)

    what, count = f"{session.header.session_id}: compared", sum(map(len, cells))
    for key, arrays in counted(scheduler.finished(score_job, jobs(), session.store), what, count, progress):
        scores.values[np.ix_(numbers[key], columns)] = arrays["values"]


def _similarity_by_strokes(session: FittedSession, number: int, scores: Scores, scheduler: Scheduler) -> Iterator[Step]:
    """Yield scores of fits from few presses on others of the session; none for a session with too few presses."""
    name = session.header.session_id
    trials = [(for_fit(few, session.header), others) for few, others in _trials(name, number, scores)]
    fits = refits([Refit(few) for few, _ in trials], session.store, scheduler, "fits from few strokes")
    values: dict[tuple[int, str], list[NDArray[np.float64]]] = {}
    for (few, others), fit in zip(trials, fits, strict=True):
        for label, model in (("CCD-BSM", fit.outline), ("Bézier", refit_bezier(few))):
            if model is not None:
                values.setdefault((len(few), label), []).extend(_on_others(model, others))
    for (count, label), of_model in sorted(values.items()):
        csim, ssim = (round(float(value), 6) for value in 100.0 * np.mean(of_model, axis=0))
        yield Step(name, count, label, csim, ssim, len(of_model))


def _on_others(outline: Draw, presses: Sequence[Press]) -> Iterator[NDArray[np.float64]]:
    """Yield CSIM and SSIM in millimetres, binary, of each press."""
    conditions = {press.condition for press in presses}
    images = {at: images_of(outline(at.depth_mm, at.tilt_deg), 0.0) for at in conditions}
    for press in presses:
        seen, drawn = (stack[MM_BINARY] / 255.0 for stack in (press.images, images[press.condition]))
        yield similarity(seen, drawn[None], Alignment.MM)[0]


def _trials(name: str, number: int, scores: Scores) -> Iterator[tuple[list[Press], list[Press]]]:
    """Yield the presses to fit and those to score on, of session `number`."""
    presses = scores.presses
    cells = [[k for k in cell if presses[k].session == name and not presses[k].cut] for cell in scores.cells]
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
                yield [presses[k] for k in order[:count]], [presses[k] for k in others]
