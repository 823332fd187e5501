"""Fit dragged strokes of a session: parameters with intervals, held-out scores, and the artefact.

A brush known from another session is adapted in its place and its width, which change whenever a brush is mounted and
its zero touch is found. Its leash and the terms that grow with depth are adapted within narrow bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import FittedValue, made_by
from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.drags.artefact import DragArtefact, DragScore
from brushloop.calibrate.drags.captures import COMMANDS, Drawn
from brushloop.calibrate.drags.fit import DragFit, bootstrap, determined, fit_drags
from brushloop.calibrate.drags.predict import Predictor, chosen, coarse, coarse_step, learn, predictors, stamps_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.spread import farthest_first
from brushloop.model.drag import DragModel
from brushloop.sessions.terminal import Progress, counted, unseen

FOLDER = "dragfit"
FOLDS = 5
LEAST = 3
"""Least number of images: fewer do not distinguish lag from drift."""
PREDICTED, LAGGING, STAMPS = "bristle lag, corrected", "bristle lag", "circle stamps"
SESSION_MM = {"drift_x_mm": 1.0, "drift_y_mm": 1.0, "half_mm": 0.4}
"""How far place and half width change from one session to another of the same brush (standard deviation)."""
LEASH_MM = 2.0
GROWTH_MM = {"half_per_mm": 0.5, "leash_per_mm": 2.0, "drift_x_per_mm": 0.5, "drift_y_per_mm": 0.5}
"""The same for the leash, and for the terms that grow with depth at the known brush's deepest stroke."""
STROKE_MM2 = 0.14
"""Weight of a square millimetre of wrong ink in such a fit. One stroke then determines the place to about 1 mm, as far
as strokes of one session scatter."""
DEPTH = COMMANDS.index("depth_mm")
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FittedDrags:
    """A fit of a session and all that is printed about it."""

    fit: DragFit
    artefact: DragArtefact


def fit_drawn(drawn: Drawn, progress: Progress = unseen) -> FittedDrags:
    """Fit all images, leave out each fifth of their conditions in turn, and make the artefact.

    Raises `CalibrationError` for fewer than three images.
    """
    if len(drawn.ink) < LEAST:
        raise CalibrationError(
            drawn.header.session_id, f"{len(drawn.ink)} images of dragged strokes, at least {LEAST} are needed"
        )
    every = np.arange(len(drawn.ink))
    learned = learn(drawn, every)
    artefact = _artefact(drawn, learned.fit, every, _values(learned.fit)).model_copy(
        update={
            "ink_above": learned.predictor.above,
            "stamps": stamps_of(learned.stamps),
            "kept": learned.predictor.kept,
            "held_out": _held_out(drawn, progress),
        }
    )
    return FittedDrags(learned.fit, artefact)


def refit_drawn(drawn: Drawn, prior: DragArtefact, where: str, strokes: int) -> FittedDrags:
    """Adapt a known brush to `strokes` images of a session, as different as possible (`session_change`).

    Raises `CalibrationError` if the session has fewer images, or if its scale is not that of `prior`.
    """
    if not 1 <= strokes <= len(drawn.ink):
        raise CalibrationError("--strokes", f"{strokes}: allowed 1 to {len(drawn.ink)}, the usable strokes")
    if abs(drawn.mm_per_px - prior.mm_per_px) > 1e-6:
        raise CalibrationError(where, f"mm_per_px is {prior.mm_per_px:g}, here {drawn.mm_per_px:g}")
    images = np.sort(different(drawn, np.arange(len(drawn.ink)), strokes))
    ours, stamps = predictors(prior, where, drawn.recording_sha256)
    fit = adapt(drawn, images, ours)
    moved = None if stamps is None else stamps_of(replace(stamps, model=adapt(drawn, images, stamps).model))
    values = {name: value for name, value in _values(fit).items() if name in fit.free}
    artefact = _artefact(drawn, fit, images, prior.parameters | values).model_copy(
        update={
            "ink_above": prior.ink_above,
            "stamps": moved,
            "kept": prior.kept,
            "prior": prior.digest,
            "prior_session": f"{prior.session_id}, {prior.source}",
            "refitted": fit.free,
        }
    )
    return FittedDrags(fit, artefact)


def different(drawn: Drawn, among: Indices, count: int) -> Indices:
    """`count` images among these whose commands are as different as possible, the most ordinary one first.

    With strokes of one kind, the model's error for that kind would look like a change of the brush's place. Figures
    have no commands, so the first ones are taken. Raises ValueError if there are fewer images.
    """
    if drawn.commands is None:
        return among[:count]
    commands = drawn.commands[among]
    spread = commands.std(axis=0)
    places = (commands - commands.mean(axis=0)) / np.where(spread > 1e-9, spread, np.inf)
    return among[farthest_first(places, int(np.linalg.norm(places, axis=1).argmin()), count)]


def adapt(drawn: Drawn, images: Indices, known: Predictor) -> DragFit:
    """Fit the parameters that change with a session to these images; the known brush's correction is kept."""
    paths, groups = chosen(drawn, images)
    ink, x_mm, y_mm = coarse(drawn, images)
    weights = drawn.weights[images] * STROKE_MM2 * float(x_mm[1] - x_mm[0]) ** 2
    missed, step = known.correction(drawn, images), coarse_step(drawn)
    return fit_drags(
        paths,
        ink,
        x_mm,
        y_mm,
        start=known.model,
        spread_mm=known.spread_mm,
        groups=groups,
        weights=weights,
        only=session_change(known),
        added_mm=None if missed is None else missed[:, ::step, ::step],
    )


def session_change(known: Predictor) -> dict[str, float]:
    """How far each parameter may change with a session (standard deviation).

    Terms that grow with depth are free only if the depths of the strokes that the brush was fitted to are known.
    """
    deepest = max(row[DEPTH] for row in known.kept.commands) if known.kept is not None else 0.0
    if deepest <= 0.0:
        return SESSION_MM
    return SESSION_MM | {"leash_mm": LEASH_MM} | {name: mm / deepest for name, mm in GROWTH_MM.items()}


def _values(fit: DragFit) -> dict[str, FittedValue]:
    """All parameters. Those that the strokes do not determine have no interval; with one image, none has."""
    low, high = np.quantile(bootstrap(fit), [0.025, 0.975], axis=0)
    known = determined(fit)
    values = {
        name: FittedValue(value=float(value), low=None, high=None)
        for name, value in zip(DragModel.names(), fit.model.vector(), strict=True)
    }
    for name, a, b, is_known in zip(fit.free, low, high, known, strict=True):
        if is_known and a < b:
            values[name] = FittedValue(value=values[name].value, low=float(a), high=float(b))
    return values


def _artefact(drawn: Drawn, fit: DragFit, images: Indices, values: dict[str, FittedValue]) -> DragArtefact:
    taken: list[int] = images.tolist()
    return DragArtefact(
        session_id=drawn.header.session_id,
        source=drawn.header.source,
        recording_sha256=drawn.recording_sha256,
        calibration=drawn.calibration.digest if drawn.calibration else "",
        software=made_by(),
        images=len(taken),
        strokes=int(np.diff(drawn.groups)[images].sum()),
        mm_per_px=round(drawn.mm_per_px, 9),
        spread_mm=fit.spread_mm,
        parameters=values,
        condition=fit.condition,
        held_out={},
        fitted_strokes=tuple(drawn.stroke_ids[k] for k in taken),
    )


def _held_out(drawn: Drawn, progress: Progress) -> dict[str, DragScore]:
    """Scores on conditions that were left out; empty for fewer than `FOLDS` conditions."""
    conditions = drawn.conditions
    order = np.random.default_rng(0).permutation(conditions.max() + 1)
    found: dict[str, list[Floats]] = {}
    for k in counted(range(FOLDS if len(order) >= FOLDS else 0), "fifths left out in turn", FOLDS, progress):
        is_left = np.isin(conditions, order[k::FOLDS])
        left, others = np.flatnonzero(is_left), np.flatnonzero(~is_left)
        learned, truth = learn(drawn, others), drawn.ink[left] > 0.5
        seen, alone = learned.predictor.ink_both_ways(drawn, left)
        if learned.predictor.kept is not None:
            found.setdefault(PREDICTED, []).append(binary_scores(seen, truth))
        found.setdefault(LAGGING, []).append(binary_scores(alone, truth))
        found.setdefault(STAMPS, []).append(binary_scores(learned.stamps.ink(drawn, left), truth))
    means = {name: (100.0 * np.concatenate(each).mean(axis=0)).tolist() for name, each in found.items()}
    return {
        name: DragScore(csim_percent=csim, iou_percent=iou, images=len(drawn.ink))
        for name, (csim, iou) in means.items()
    }
