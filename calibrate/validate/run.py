"""The run: read every press, fit to other conditions, score every model. Finished work is never repeated.

The models are every registered one, the fitted brush, refits to other conditions, and trained generators. Each result
depends only on its inputs, so neither the order nor the place of work changes it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.commands import ValidateRequest
from brushloop.calibrate.compare import MM_BINARY, Alignment, Pixels, brush_of, images_of, similarity, simulated
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.command import BrushFit
from brushloop.calibrate.fit.heldout import Refit, leave_out, refits
from brushloop.calibrate.presses import Press, beside_touch, for_fit, read_presses, too_thin, uncommanded
from brushloop.calibrate.scores import Scores, similarities
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stats import CEILING, others_of
from brushloop.calibrate.work import Arrays, Scheduler, key_of
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.fitted import NAME as FITTED
from brushloop.model.fitted import fitted_model
from brushloop.model.generator import SHIPPED_GENERATOR
from brushloop.model.generator.stroke import load_generator
from brushloop.model.presses import DepthTilt, Draw, refit_bezier
from brushloop.model.strokes import StrokeModel, stroke_model, stroke_models
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, counted, unseen

PUBLISHED, NOT_PREDICTED = "as published", "does not predict this press"
HELD_OUT = "fitted, held-out conditions"
PRESSES = "captured presses"
FITTED_HELD_OUT, BEZIER_REFITTED = "ccd-bsm-heldout", "bezier-refitted"
ANOTHER = "another press"
PRESS_ROWS = {
    ANOTHER: "A capture predicted by other captures of its condition, averaged: how well the brush repeats a press. A "
    "model can do better, because both presses stray from their average image.",
    CEILING: "The score of a perfect model, which draws the best image of each condition: estimated from the "
    "similarity of other presses of the condition.",
}
"""Definitions of what stands in the tables beside the models."""
LAMBDAS = {"ccd-bsm-lambda-1": 1.0, "ccd-bsm-lambda-pi/2": 0.5 * math.pi}
"""Values compared in addition to lambda = pi, which is CCD-BSM itself: the paper's figure 3."""
ORDER = ("ccd-bsmg", "ccd-bsm", FITTED, FITTED_HELD_OUT, "bezier", BEZIER_REFITTED, "ellipse", "line", "circle")
"""Of the paper's tables, calibrated next to uncalibrated."""
COUNTS = (1, 2, 3, 5, 9, 15, 30, 60)
"""Numbers of fitted presses for which similarity is told."""
DRAWS = 2
"""Random draws to average, since a fit from few presses depends on which are drawn."""
MAX_SCORED, MIN_LEFT = 200, 5
"""Most and fewest other presses that such a fit is scored on."""


@dataclass(frozen=True, slots=True)
class FittedSession(OpenSession):
    """An open session and the brush fit that it uses."""

    fit: BrushFit | None


class ModelInfo(Frozen):
    """What a report says of a model, or of what its rows are compared with."""

    name: str
    label: str
    definition: str
    basis: str
    """What it knows of these presses: `as published`, `fitted, in sample`, `fitted, held-out conditions`, ..."""
    sha256: str = ""
    """Hash of a generator's file."""


@dataclass(frozen=True, slots=True)
class Model:
    """A model to compare with the presses of one session: one row of the tables."""

    info: ModelInfo
    images: Callable[[Condition], Pixels]
    """What it predicts for a condition; raises `DomainError` for a press that it does not predict."""


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
    refused: list[Refused]
    steps: list[Step]
    """Similarity by number of fitted presses; empty without ablations."""

    def predicted(self, press: Press) -> tuple[dict[str, Pixels], list[str]]:
        """(len(KEYS), 128, 128) of a press by the models that predict it, and why the others do not."""
        images, refused = dict[str, Pixels](), list[str]()
        for model in self.models[press.session]:
            try:
                images[model.info.name] = model.images(press.condition)
            except DomainError as error:
                refused.append(f"{model.info.name} {NOT_PREDICTED}: {error}")
        return images, refused


def validate_presses(
    sessions: Sequence[FittedSession], request: ValidateRequest, scheduler: Scheduler, progress: Progress = unseen
) -> Outcome:
    """Compare every model with every press.

    Raises `CalibrationError` for an unknown model, or if two sessions have the same name.
    """
    models = {session.header.session_id: known_models(session, request) for session in sessions}
    if len(models) < len(sessions):
        raise CalibrationError(sessions[-1].header.session_id, "two sessions have this name")
    possible = [*(model.info.name for known in models.values() for model in known), BEZIER_REFITTED]
    possible += [FITTED_HELD_OUT] if any(session.fit for session in sessions) else []
    for name in request.models:
        if name not in possible:
            names = ", ".join(dict.fromkeys(possible))
            raise CalibrationError("--model", f"{name!r} is not one of: {names}; some need a fit or --generator")
    refused: list[Refused] = []
    presses: list[Press] = []
    for session in sessions:
        name, left_out = session.header.session_id, list[tuple[str, str]]()
        reasons = uncommanded, too_thin, beside_touch
        of_session = list(read_presses(session, left_out, *reasons, scheduler=scheduler, progress=progress))
        refused += (Refused(name, *reason) for reason in left_out)
        every = in_order([*models[name], *_held_out(session, of_session, request, scheduler, progress)])
        models[name] = [model for model in every if not request.models or model.info.name in request.models]
        presses += of_session
    names = dict.fromkeys(model.info.name for model in in_order([m for group in models.values() for m in group]))
    outcome = Outcome(sessions, request, models, Scores(presses, (*names, ANOTHER)), refused, [])
    for number, session in enumerate(sessions):
        _score(outcome, session, scheduler, progress)
        if request.ablations:
            outcome.steps.extend(_similarity_by_strokes(session, number, outcome.scores, scheduler))
    return outcome


def in_order(models: Sequence[Model]) -> list[Model]:
    """Sort in the order of the paper's tables, all others last."""
    return sorted(models, key=lambda model: ORDER.index(model.info.name) if model.info.name in ORDER else len(ORDER))


def known_models(session: FittedSession, request: ValidateRequest) -> Sequence[Model]:
    """The models that need no held-out fit: generators, the registered models of the brush, and its fit.

    Where no generator is given, the shipped one is used for brushes of its size. Raises what `load_generator` does, and
    `CalibrationError` for two generators of one name.
    """
    brush, fit = brush_of(session.header), session.fit
    models = [_of_model(model, PUBLISHED) for model in stroke_models(brush).values()]
    if fit is not None:
        basis = "fitted, in sample" if fit.recording_sha256 == session.sha256 else f"fitted on {fit.session_id}"
        models.append(_of_model(fitted_model(fit.press(), "CCD-BSM fitted"), basis))
    for name, lam in LAMBDAS.items() if request.ablations else ():
        label = f"CCD-BSM, λ = {name.rpartition('-')[2].replace('pi', 'π')}"
        models.append(_of_model(stroke_model("ccd-bsm", brush, lam), PUBLISHED, name=name, label=label))
    for file in request.generators or ([SHIPPED_GENERATOR] if brush == Brush() else []):
        model = load_generator(file, brush)
        if model.name in [known.info.name for known in models]:
            raise CalibrationError(str(file), f"is a second generator named {model.name}")
        basis = f"trained on exact images of {model.target.stroke_model.label}"
        basis += ", then tuned on captures" if model.fitted else ""
        models.append(_of_model(model, basis, sha256=file_sha256(file)))
    return models


def _of_model(model: StrokeModel, basis: str, **changes: str) -> Model:
    info = ModelInfo(name=model.name, label=model.label, definition=model.definition, basis=basis)
    return Model(info.model_copy(update=changes), lambda at: simulated(model, at.depth_mm, at.tilt_deg))


def _held_out(
    session: FittedSession, presses: Sequence[Press], request: ValidateRequest, scheduler: Scheduler, progress: Progress
) -> Iterator[Model]:
    """Yield the models fitted to the session without the conditions that they predict."""
    wanted = request.models or (FITTED_HELD_OUT, BEZIER_REFITTED)
    if not request.held_out or not {FITTED_HELD_OUT, BEZIER_REFITTED} & {*wanted}:
        return
    whole = for_fit([press for press in presses if not press.cut], session.header)
    asked = [(press.condition.depth_mm, press.condition.tilt_deg) for press in presses]
    left_out = leave_out(whole, {condition: list[int]() for condition in asked} | whole.conditions)
    if not left_out:
        return
    if session.fit is not None:
        start = session.fit.press()
        size = {"radius_mm": start.radius_mm, "length_mm": start.length_mm}
        jobs = [Refit(replace(others, **size), start=start.values) for _, others in left_out]
        what = f"{session.header.session_id}: conditions left out in turn"
        fits = refits(jobs, session.store, scheduler, what, progress)
        brushes = {at: fit.outline for (fold, _), fit in zip(left_out, fits, strict=True) for at in fold}
        how = "CCD-BSM's lengths with gains, powers, profile and edges fitted to"
        yield _left_out(FITTED_HELD_OUT, "CCD-BSM calibrated", how, brushes)
    how = "Two mirrored cubic Bezier curves; ends, belly and shoulder regressed on"
    curves = {at: refit_bezier(others) for fold, others in left_out for at in fold}
    yield _left_out(BEZIER_REFITTED, "Bezier refitted", how, curves)


def _left_out(name: str, label: str, how: str, outlines: Mapping[DepthTilt, Draw | None]) -> Model:
    """A model that was fitted without the condition that it predicts; None where the other conditions are too few."""

    def images(at: Condition) -> Pixels:
        outline = outlines.get((at.depth_mm, at.tilt_deg))
        if outline is None:
            hint = f"at tilt_deg = {at.tilt_deg:g}"
            raise DomainError("depth_mm", at.depth_mm, "what the other conditions determine", hint)
        return images_of(outline(at.depth_mm, at.tilt_deg), 0.0)

    definition = f"{how} the captures of all other conditions."
    return Model(ModelInfo(name=name, label=label, definition=definition, basis=HELD_OUT), images)


ScoreJob = tuple[Pixels, tuple[Sequence[Pixels], ...]]
"""A press (len(KEYS), 128, 128), and the images of each comparison, of that shape, whose scores are averaged."""


def score_job(job: ScoreJob) -> Arrays:
    """`values` (comparisons, KEYS, 2): CSIM and SSIM, NaN where there is nothing to compare with."""
    return {"values": similarities(*job)}


def _score(outcome: Outcome, session: FittedSession, scheduler: Scheduler, progress: Progress) -> None:
    """Fill the table for one session: every press against every model, and against other presses of its condition."""
    scores, names = outcome.scores, [model.info.name for model in outcome.models[session.header.session_id]]
    columns = [scores.models.index(name) for name in (*names, ANOTHER)]
    groups = [group for group in scores.groups if scores.presses[group[0]].session == session.header.session_id]
    numbers: dict[str, list[int]] = {}
    """Numbers of presses by the key of their job: equal presses share one."""

    def jobs() -> Iterator[tuple[str, ScoreJob]]:
        for group in groups:
            presses = [scores.presses[k] for k in group]
            images, reasons = outcome.predicted(presses[0])
            for why in reasons:
                outcome.refused.extend(Refused(press.session, press.stroke.stroke_id, why) for press in presses)
            predictions = [[images[name]] if name in images else [] for name in names]
            of_models = [key_of(*drawn) for drawn in predictions]
            of_presses = [key_of(press.images) for press in presses]
            for number, press in enumerate(presses):
                others = others_of(number, len(group))
                key = key_of("score", of_presses[number], *of_models, *(of_presses[other] for other in others))
                numbers.setdefault(key, []).append(group[number])
                yield key, (press.images, (*predictions, [presses[other].images for other in others]))

    what, count = f"{session.header.session_id}: compared", sum(map(len, groups))
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
    whole = [[k for k in group if presses[k].session == name and not presses[k].cut] for group in scores.groups]
    for draw in range(DRAWS):
        rng = np.random.default_rng([draw, number])
        # Every condition once before any condition twice, as a person would choose.
        groups = [[int(k) for k in rng.permutation(group)] for group in whole if group]
        groups = [groups[int(g)] for g in rng.permutation(len(groups))]
        order = [k for turn in itertools.zip_longest(*groups) for k in turn if k is not None]
        for count in COUNTS:
            left = order[count:]
            if len(left) >= MIN_LEFT:
                others = sorted(left[:: max(1, -(-len(left) // MAX_SCORED))])
                yield [presses[k] for k in order[:count]], [presses[k] for k in others]
