"""The dragged brush of a session: learned from its strokes, kept in a file, and adapted to another session.

A brush known from another session is adapted in its place and its width, which change whenever a brush is mounted and
its zero touch is found. Its leash and the terms that grow with depth are adapted within narrow bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import FittedValue, Frozen, SessionFit, made_by
from brushloop.calibrate.drags.captures import COMMANDS, Drawn
from brushloop.calibrate.drags.fit import (
    CIRCLES,
    CIRCLES_FREEDOM,
    INK_ABOVE,
    SPREAD_MM,
    Correction,
    DragFit,
    Kept,
    captured_distance,
    clipped,
    fit_drags,
    marks_mm,
    threshold,
)
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.stats import farthest_first
from brushloop.model.drag import DragModel, Floats, Indices, ink
from brushloop.model.similarity import binary_scores
from brushloop.sessions.terminal import Progress, counted, unseen

BETWEEN_SESSIONS = 0.66
"""Share of a correction that is used in another session than the one it was learned in: the slope, through zero, of
what the lag misses there on the correction. It is .75 and .57 for two sessions of one brush (`bench drags`)."""
FIT_MM = 0.8
"""Scale of the images that the parameters are fitted to: finer ones do not change the fit."""
STAMP_SPREAD_MM = 1.5
STAMP_ABOVE = (0.22, 0.26, 0.3, 0.34, 0.38, 0.42)
"""Thresholds tried for circle stamps, of which the best on the training strokes is used. The errors of stamps vary more
than those of the lag, so their edge spread differs, too."""
SESSION_MM = {"drift_x_mm": 1.0, "drift_y_mm": 1.0, "half_mm": 0.4}
"""How far place and half width change from one session to another of the same brush (standard deviation)."""
LEASH_MM = 2.0
GROWTH_MM = {"half_per_mm": 0.5, "leash_per_mm": 2.0, "drift_x_per_mm": 0.5, "drift_y_per_mm": 0.5}
"""The same for the leash, and for the terms that grow with depth at the known brush's deepest stroke."""
STROKE_MM2 = 0.14
"""Weight of a square millimetre of wrong ink in such a fit. One stroke then determines the place to about 1 mm, as far
as strokes of one session scatter."""
Masks = NDArray[np.bool_]
FOLDER = "dragfit"
FOLDS = 5
LEAST = 3
"""Least number of images: fewer do not distinguish lag from drift."""
PREDICTED, LAGGING, STAMPS = "bristle lag, corrected", "bristle lag", "circle stamps"
Probability = Annotated[float, Field(gt=0.0, lt=1.0)]


@dataclass(frozen=True, slots=True)
class Predictor:
    """A drag model with its edge, its threshold and what it learned from its training strokes."""

    model: DragModel
    spread_mm: float = SPREAD_MM
    above: float = INK_ABOVE
    correction: Correction | None = None
    share: float = 1.0
    """Share of the correction that is used: 1 in the session that it was learned in, `BETWEEN_SESSIONS` in others."""

    def ink(self, drawn: Drawn, images: Indices) -> tuple[Masks, Masks]:
        """The ink that these images should show, and the same without the correction, (n, len(y_mm), len(x_mm))."""
        away = marks_mm(self.model, drawn.drawings.only(images))
        alone, added = self.is_ink(away), self.added_mm(drawn, images)
        return (alone if added is None else self.is_ink(clipped(away) + added)), alone

    def added_mm(self, drawn: Drawn, images: Indices) -> Floats | None:
        """What the correction adds to signed distances once they are clipped; None without one, or for figures."""
        if self.correction is None or drawn.commands is None:
            return None
        return self.share * self.correction.added_mm(drawn.commands[images], drawn.drawings.x_mm, drawn.drawings.y_mm)

    def is_ink(self, away_mm: NDArray[np.floating]) -> Masks:
        """Whether a pixel at this signed distance counts as ink."""
        return ink(np.asarray(away_mm, np.float64), self.spread_mm) > self.above


@dataclass(frozen=True, slots=True)
class Learned:
    """Fits to one set of images."""

    fit: DragFit
    predictor: Predictor
    kept: Kept | None
    stamps: Predictor


def learn(drawn: Drawn, images: Indices) -> Learned:
    """Fit lag, correction, threshold and circle stamps to these images of a session."""
    drawings, coarse = drawn.drawings.only(images), drawn.drawings.only(images).every(coarse_step(drawn))
    fit = fit_drags(coarse)
    predictor, kept = Predictor(fit.model), None
    if drawn.commands is not None and len(images) > 1:
        commands = drawn.commands[images]
        captured = captured_distance(drawings.ink > 0.5, drawn.mm_per_px)
        above = threshold(commands, marks_mm(fit.model, drawings), captured)
        kept = Kept.of(commands, drawings, fit.model)
        predictor = Predictor(fit.model, above=above, correction=kept.correction() if kept is not None else None)
    circles = fit_drags(coarse, start=CIRCLES, freedom=CIRCLES_FREEDOM, spread_mm=STAMP_SPREAD_MM).model
    each = [Predictor(circles, STAMP_SPREAD_MM, above) for above in STAMP_ABOVE]
    away, truth = marks_mm(circles, drawings), drawings.ink > 0.5
    stamps = max(each, key=lambda one: float(binary_scores(one.is_ink(away), truth)[:, 0].mean()))
    return Learned(fit, predictor, kept, stamps)


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
    step, added = coarse_step(drawn), known.added_mm(drawn, images)
    return fit_drags(
        drawn.drawings.only(images).every(step).weighted(STROKE_MM2 * (step * drawn.mm_per_px) ** 2),
        start=known.model,
        freedom=session_change(known),
        spread_mm=known.spread_mm,
        added_mm=None if added is None else added[:, ::step, ::step],
    )


def session_change(known: Predictor) -> dict[str, float]:
    """How far each parameter may change with a session (standard deviation).

    Terms that grow with depth are free only if the depths of the strokes that the brush was fitted to are known.
    """
    deepest = 0.0 if known.correction is None else known.correction.commands[:, COMMANDS.index("depth_mm")].max()
    growth = {"leash_mm": LEASH_MM} | {name: mm / deepest for name, mm in GROWTH_MM.items()} if deepest > 0.0 else {}
    changes = SESSION_MM | growth
    return {name: changes[name] for name in DragModel.names() if name in changes}


def correction_helps(corrected: Masks, alone: Masks, truth: Masks) -> bool:
    """Whether the strokes that were seen are predicted better with the correction; as usual if none was seen."""
    if not len(truth):
        return True
    with_it, without = (float(binary_scores(ink, truth)[:, 0].mean()) for ink in (corrected, alone))
    return with_it > without


def coarse_step(drawn: Drawn) -> int:
    """Number of pixels that make about `FIT_MM`."""
    return max(1, round(FIT_MM / drawn.mm_per_px))


class DragScore(Frozen):
    """Score of one model on images that it was not fitted to, ink as 0 or 1, at the commanded place."""

    csim_percent: float
    iou_percent: float
    images: int


class DragArtefact(SessionFit):
    """The fitted drag model on disk. Equal inputs give an equal file."""

    images: int
    strokes: int
    mm_per_px: float
    parameters: dict[str, FittedValue]
    held_out: dict[str, DragScore] = Field(default_factory=dict)
    """Scores by model; empty with too few images to leave any out."""
    ink_above: Probability = INK_ABOVE
    """A pixel counts as ink above this probability: chosen on the training strokes."""
    stamps: Annotated[list[float], Field(min_length=14, max_length=14)]
    """Circle stamps fitted to the same strokes: what a report shows beside the lag."""
    stamps_above: Probability
    kept: Kept | None = None
    """Training strokes, from which the correction of the lag is computed; None for figures."""
    fitted_strokes: tuple[str, ...] = ()
    """The strokes that were fitted, which must not be scored as held out."""
    prior: str = ""
    """Digest of the fit whose brush was adapted to this session; empty for a fit of its own."""
    prior_session: str = ""
    refitted: tuple[str, ...] = ()
    """The parameters that were adapted."""

    def model(self) -> DragModel:
        """The fitted drag model."""
        return DragModel(**{name: value.value for name, value in self.parameters.items()})

    def stamp_predictor(self) -> Predictor:
        """Circle stamps as they predict."""
        return Predictor(DragModel.of(np.array(self.stamps)), STAMP_SPREAD_MM, self.stamps_above)

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if set(self.parameters) != set(DragModel.names()):
            raise ValueError(f"parameters: expected {', '.join(DragModel.names())}")
        return self

    def predictor(self, where: str, recording_sha256: str) -> Predictor:
        """The predictor for a recording. Raises `CalibrationError`, naming `where`, for ink that cannot be read."""
        try:
            correction = self.kept.correction() if self.kept is not None else None
        except (ValueError, np.linalg.LinAlgError) as error:
            raise CalibrationError(where, f"kept: {error}") from None
        own = not self.prior and self.recording_sha256 == recording_sha256
        share = 1.0 if own else BETWEEN_SESSIONS
        return Predictor(self.model(), above=self.ink_above, correction=correction, share=share)


def fit_drawn(drawn: Drawn, progress: Progress = unseen) -> DragArtefact:
    """Fit all images, leave out each fifth of their conditions in turn, and make the artefact.

    Raises `CalibrationError` for fewer than three images.
    """
    count = len(drawn.stroke_ids)
    if count < LEAST:
        what = f"{count} images of dragged strokes, at least {LEAST} are needed"
        raise CalibrationError(drawn.header.session_id, what)
    learned = learn(drawn, np.arange(count))
    held_out = _held_out(drawn, progress)
    return _artefact(
        drawn,
        np.arange(count),
        learned.fit.values(),
        learned.stamps,
        ink_above=learned.predictor.above,
        kept=learned.kept,
        held_out=held_out,
    )


def refit_drawn(drawn: Drawn, prior: DragArtefact, where: str, strokes: int) -> DragArtefact:
    """Adapt a known brush to `strokes` images of a session, as different as possible (`session_change`).

    Raises `CalibrationError` if the session has fewer images, or if its scale is not that of `prior`.
    """
    count = len(drawn.stroke_ids)
    if not 1 <= strokes <= count:
        raise CalibrationError("--strokes", f"{strokes}: allowed 1 to {count}, the usable strokes")
    if abs(drawn.mm_per_px - prior.mm_per_px) > 1e-6:
        raise CalibrationError(where, f"mm_per_px is {prior.mm_per_px:g}, here {drawn.mm_per_px:g}")
    images = np.sort(different(drawn, np.arange(count), strokes))
    fit = adapt(drawn, images, prior.predictor(where, drawn.recording_sha256))
    stamps = prior.stamp_predictor()
    adapted = {name: value for name, value in fit.values().items() if name in fit.freedom}
    return _artefact(
        drawn,
        images,
        prior.parameters | adapted,
        replace(stamps, model=adapt(drawn, images, stamps).model),
        ink_above=prior.ink_above,
        kept=prior.kept,
        prior=prior.digest,
        prior_session=f"{prior.session_id}, {prior.source}",
        refitted=tuple(fit.freedom),
    )


def _artefact(
    drawn: Drawn, images: Indices, values: dict[str, FittedValue], stamps: Predictor, **more: Any
) -> DragArtefact:
    return DragArtefact(
        session_id=drawn.header.session_id,
        source=drawn.header.source,
        recording_sha256=drawn.recording_sha256,
        calibration=drawn.calibration.digest if drawn.calibration else "",
        software=made_by(),
        images=len(images),
        strokes=len(drawn.drawings.only(images).paths),
        mm_per_px=round(drawn.mm_per_px, 9),
        parameters=values,
        stamps=stamps.model.vector().tolist(),
        stamps_above=stamps.above,
        fitted_strokes=tuple(drawn.stroke_ids[int(k)] for k in images),
        **more,
    )


def _held_out(drawn: Drawn, progress: Progress) -> dict[str, DragScore]:
    """Scores on conditions that were left out; empty for fewer than `FOLDS` conditions."""
    conditions = drawn.conditions
    order = np.random.default_rng(0).permutation(conditions.max() + 1)
    found: dict[str, list[Floats]] = {}
    for k in counted(range(FOLDS if len(order) >= FOLDS else 0), "fifths left out in turn", FOLDS, progress):
        is_left = np.isin(conditions, order[k::FOLDS])
        left, others = np.flatnonzero(is_left), np.flatnonzero(~is_left)
        learned, truth = learn(drawn, others), drawn.drawings.ink[left] > 0.5
        seen, alone = learned.predictor.ink(drawn, left)
        if learned.kept is not None:
            found.setdefault(PREDICTED, []).append(binary_scores(seen, truth))
        found.setdefault(LAGGING, []).append(binary_scores(alone, truth))
        found.setdefault(STAMPS, []).append(binary_scores(learned.stamps.ink(drawn, left)[0], truth))
    means = {name: (100.0 * np.concatenate(each).mean(axis=0)).tolist() for name, each in found.items()}
    images = len(drawn.stroke_ids)
    return {name: DragScore(csim_percent=csim, iou_percent=iou, images=images) for name, (csim, iou) in means.items()}
