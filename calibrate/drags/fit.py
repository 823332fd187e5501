"""The dragged brush of a session: learned from its strokes, kept in a file, and adapted to another session.

The fit of `model.drag`'s lag and width minimises the squared difference between captured ink and the model's
probability of ink, with an edge that varies by `SPREAD_MM` from stroke to stroke. This gives the best image on average,
and so the best cosine similarity. What the lag misses is learned from the training strokes by kernel ridge regression
on clipped signed distances.

A brush known from another session is adapted in its place and its width, which change whenever a brush is mounted and
its zero touch is found. Its leash and the terms that grow with depth are adapted within narrow bounds. What its lag
missed in the other session is left behind.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import FittedValue, Frozen, SessionFit
from brushloop.calibrate.drags import COMMANDS, MM_PER_PX, Drags, commanded_path
from brushloop.calibrate.errors import CalibrationError
from brushloop.model.drag import DragModel, Drawings, Floats, Indices, Trails, derivatives, fit_to_ink, lagging
from brushloop.model.presses import farthest_first
from brushloop.model.similarity import binary_scores
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.terminal import Progress, counted, unseen

PREDICTED, LAG = "predicted", "bristle lag alone"
SPREAD_MM = 0.9
"""Scale of the logistic: an edge that varies by 1.6 mm (standard deviation)."""
INK_ABOVE = 0.4
"""A pixel counts as ink above this probability. Half of the attainable Dice score maximises its expectation; on real
strokes that half is .39 to .43, and scores change by .003 at most between these."""
EDGE_MM = SPREAD_MM * float(np.log(INK_ABOVE / (1.0 - INK_ABOVE)))
"""Signed distance at which the probability of ink is `INK_ABOVE`."""
FREEDOM = dict(zip(DragModel.names(), (2.0, 0.2, 0.01, 3.0, 1.0, 4.0, 1.5, 1.5, 0.2, 0.2, 3.0, 0.5, 0.5), strict=True))
"""Standard deviations of the prior: a parameter this far from its start costs as much as a pixel of wrong ink."""
FIT_MM = 0.8
"""Scale of the images that the parameters are fitted to: finer ones do not change the fit."""
DRAWS = 500
UNDETERMINED = 0.5
"""A parameter keeps no interval if the strokes reduce the variance of its weak prior by less than this share."""
REACH_MM = 6.0
"""Distance at which signed distances level off, because far from the edge they carry no information."""
SPREADS = (2.2, 2.2, 2.2, 2.2, 5.0)
"""Width of the kernel in standard deviations of each of `COMMANDS` of the training strokes; the tilt matters little on
real ink within 5 deg."""
RIDGE = 2.0
SESSION_MM = {"drift_x_mm": 1.0, "drift_y_mm": 1.0, "half_mm": 0.4, "leash_mm": 2.0}
"""How far place, half width and leash change from one session to another of the same brush (standard deviation)."""
GROWTH_MM = {"half_per_mm": 0.5, "leash_per_mm": 2.0, "drift_x_per_mm": 0.5, "drift_y_per_mm": 0.5}
"""The same for the terms that grow with depth, at the deepest stroke."""
STROKE_MM2 = 0.14
"""Weight of a square millimetre of wrong ink in such a fit. One stroke then determines the place to about 1 mm, as far
as strokes of one session scatter."""
FOLDS, LEAST = 5, 3
"""Parts of a cross-validation; least number of strokes: fewer do not distinguish lag from drift."""
MOST_STROKES, MOST_BYTES = 200, 700_000
"""Of the training strokes that an artefact keeps: number, and size of their images in base64."""
Masks = NDArray[np.bool_]
Number = Annotated[float, Field(ge=-1e6, le=1e6)]


def fit_values(
    drawings: Drawings, start: DragModel | None = None, freedom: Mapping[str, float] = FREEDOM
) -> dict[str, FittedValue]:
    """Fit the parameters that `freedom` names, with the standard deviations of their prior around `start`.

    The intervals come from a bootstrap over images, in which a draw is one Gauss-Newton step. Parameters that the
    strokes do not determine have no interval; with one image, none has. With fewer than about 8 images the intervals
    are too short.
    """
    begin = (start or DragModel()).vector()
    at = [DragModel.names().index(name) for name in freedom]
    sd = np.array(list(freedom.values()))

    def trails_at(scaled: Floats) -> Trails:
        vector = begin.copy()
        vector[at] += sd * scaled
        return lagging(drawings.paths, vector)

    scaled = fit_to_ink(trails_at, np.zeros(len(at)), drawings, SPREAD_MM)
    trails, slopes = trails_at(scaled), derivatives(trails_at, scaled)
    count, unit = len(drawings.ink), np.eye(len(at))
    of_images = [
        replace(trails, groups=trails.groups[k : k + 2]).equations(slopes, drawings.only(np.array([k])), SPREAD_MM)
        for k in range(count)
    ]
    squares = np.array([each.square for each in of_images])
    gradients = np.array([each.gradient for each in of_images])
    weights = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), DRAWS).astype(np.float64)
    steps = np.linalg.solve(np.tensordot(weights, squares, 1) + unit, -(weights @ gradients + scaled)[..., None])
    ends = np.quantile(steps[..., 0], [0.025, 0.975], axis=0)
    variance = np.diag(np.asarray(np.linalg.inv(squares.sum(axis=0) + unit), np.float64))
    known = (variance < 1.0 - UNDETERMINED) & (ends[0] < ends[1])
    values = begin[at] + sd * scaled
    rows = zip(values.tolist(), *(values + sd * ends).tolist(), known.tolist(), strict=True)
    return {
        name: FittedValue(value=value, low=low if is_known else None, high=high if is_known else None)
        for name, (value, low, high, is_known) in zip(freedom, rows, strict=True)
    }


def model_of(values: Mapping[str, FittedValue]) -> DragModel:
    """The drag model of fitted parameters, all of them by name."""
    return DragModel(**{name: fitted.value for name, fitted in values.items()})


class Kept(Frozen):
    """Commands and ink of training strokes: a kernel ridge over them says what the lag misses.

    The images have square pixels of `MM_PER_PX`, rows from the top. Files come from elsewhere: sizes are checked.
    """

    commands: Annotated[list[tuple[Number, Number, Number, Number, Number]], Field(max_length=MOST_STROKES)]
    """`COMMANDS` of each stroke."""
    left_mm: Number
    """Centre of the first column; the stroke starts at x = 0."""
    top_mm: Number
    """Centre of the first row, y upward."""
    ink: Annotated[str, Field(max_length=MOST_BYTES)]
    """All images below each other, as a PNG in base64."""

    @staticmethod
    def of(drags: Drags, images: Indices) -> Kept:
        """These strokes, evenly chosen if there are too many. Raises `CalibrationError` for too fine images."""
        used, drawings = images[:: -(-len(images) // MOST_STROKES)], drags.drawings
        picture = 255 * (drawings.ink[used] > 0.5).astype(np.uint8).reshape(-1, len(drawings.x_mm))
        data = base64.b64encode(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes()).decode()
        if len(data) > MOST_BYTES:
            what = f"holds strokes so long that {len(used)} of them do not fit into the artefact"
            raise CalibrationError(drags.session.header.session_id, what)
        return Kept(
            commands=np.round(drags.commands[used], 6).tolist(),
            left_mm=round(float(drawings.x_mm[0]), 6),
            top_mm=round(float(drawings.y_mm[0]), 6),
            ink=data,
        )

    @model_validator(mode="after")
    def _readable(self) -> Self:
        try:
            rows = len(self._picture())
        except (ValueError, SessionDamaged) as error:
            raise ValueError(f"ink cannot be read ({error})") from None
        if not self.commands or rows % len(self.commands):
            raise ValueError(f"ink of {rows} rows, expected those of {len(self.commands)} strokes")
        return self

    def _picture(self) -> NDArray[np.uint8]:
        return decode_gray(base64.b64decode(self.ink, validate=True), "ink")

    def missed_mm(self, model: DragModel, commands: Floats, x_mm: Floats, y_mm: Floats) -> Floats:
        """What `model` misses of strokes of (n, 5) commands, to be added to clipped signed distances; 0 outside.

        Returns (n, len(y_mm), len(x_mm)) on a grid of the same scale.
        """
        from scipy.interpolate import RBFInterpolator  # slow to import

        known, picture = np.array(self.commands), self._picture()
        seen = (picture > 127).reshape(len(known), -1, picture.shape[1])
        own_x = np.asarray(self.left_mm + np.arange(seen.shape[2]) * MM_PER_PX, np.float64)
        own_y = np.asarray(self.top_mm - np.arange(seen.shape[1]) * MM_PER_PX, np.float64)
        drawn = lagging([commanded_path(*row[:4]) for row in self.commands], model.vector()).distances(own_x, own_y)
        missed = clipped(captured_distance(seen, MM_PER_PX)) - clipped(drawn)
        spread = known.std(axis=0)
        # A command that never changes in training has no influence.
        scales = np.where(spread > 1e-9, np.array(SPREADS) * spread, 1e9)
        images, width = missed.reshape(len(known), -1), 0.5**0.5
        ridge = RBFInterpolator(known / scales, images, smoothing=RIDGE, kernel="gaussian", epsilon=width, degree=-1)
        change = np.pad(ridge(commands / scales).reshape(-1, *seen.shape[1:]), ((0, 0), (1, 1), (1, 1)))
        # The margin of 0 stands for everything outside the known grid.
        rows = np.rint((self.top_mm - y_mm) / MM_PER_PX + 1).clip(0, seen.shape[1] + 1).astype(np.int64)
        columns = np.rint((x_mm - self.left_mm) / MM_PER_PX + 1).clip(0, seen.shape[2] + 1).astype(np.int64)
        return np.asarray(change[:, rows[:, None], columns], np.float64)


def predicted(model: DragModel, kept: Kept | None, drags: Drags, images: Indices) -> dict[str, Masks]:
    """The ink that these strokes should show, by row of a report, (n, len(y_mm), len(x_mm)) each.

    `PREDICTED` is the best prediction, and `LAG`, where strokes correct it, that without them.
    """
    drawings = drags.drawings.only(images)
    away = lagging(drawings.paths, model.vector()).distances(drawings.x_mm, drawings.y_mm)
    if kept is None:
        return {PREDICTED: away > EDGE_MM}
    missed = kept.missed_mm(model, drags.commands[images], drawings.x_mm, drawings.y_mm)
    return {PREDICTED: clipped(away) + missed > EDGE_MM, LAG: away > EDGE_MM}


def clipped(distance_mm: NDArray[np.floating]) -> NDArray[np.float32]:
    """Signed distance that levels off at `REACH_MM`."""
    return (REACH_MM * np.tanh(np.asarray(distance_mm, np.float32) / REACH_MM)).astype(np.float32)


def captured_distance(masks: NDArray[np.bool_], mm_per_px: float) -> Floats:
    """Signed distance to the edge of captured ink (n, rows, columns), positive inside, mm."""

    def to_other(inked: NDArray[np.bool_]) -> list[cv2.typing.MatLike]:
        return [cv2.distanceTransform(each, cv2.DIST_L2, 5) - 0.5 for each in inked.astype(np.uint8)]

    return np.where(masks, np.array(to_other(masks)), -np.array(to_other(~masks))).astype(np.float64) * mm_per_px


class DragArtefact(SessionFit):
    """The fitted drag model on disk. Equal inputs give an equal file."""

    FOLDER: ClassVar[str] = "dragfit"

    mm_per_px: Annotated[float, Field(ge=MM_PER_PX, le=MM_PER_PX)]
    """Scale of the grid: ink on another grid is refused."""
    parameters: dict[str, FittedValue]
    held_out: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """CSIM and IoU by model of strokes that it was not fitted to, percent; empty with too few to leave any out."""
    kept: Kept | None = None
    """Training strokes that correct the lag; None for a brush that was adapted."""
    fitted_strokes: tuple[str, ...] = ()
    """The strokes that were fitted, which must not be scored as held out."""
    prior: str = ""
    """Digest of the fit whose brush was adapted to this session; empty for a fit of its own."""
    prior_session: str = ""
    refitted: tuple[str, ...] = ()
    """The parameters that were adapted."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if set(self.parameters) != set(DragModel.names()):
            raise ValueError(f"parameters: expected {', '.join(DragModel.names())}")
        return self


def fit_drags(drags: Drags, progress: Progress = unseen) -> DragArtefact:
    """Fit all strokes, leave out each fifth of their commands in turn, and make the artefact.

    Raises `CalibrationError` for fewer than three strokes without a defect.
    """
    images = drags.sound
    if len(images) < LEAST:
        what = f"{len(images)} dragged strokes without a defect, at least {LEAST} are needed"
        raise CalibrationError(drags.session.header.session_id, what)
    held_out, kept = _held_out(drags, progress), Kept.of(drags, images)
    return _artefact(drags, images, fit_values(_coarse(drags, images)), held_out=held_out, kept=kept)


def adapt_drags(drags: Drags, prior: DragArtefact, strokes: int) -> DragArtefact:
    """Adapt a known brush to `strokes` strokes of a session, as different as possible (`session_change`).

    Raises `CalibrationError` if the session has fewer.
    """
    count = len(drags.sound)
    if not 1 <= strokes <= count:
        raise CalibrationError("--strokes", f"{strokes}, allowed: 1 to {count}, the number of usable strokes")
    images = np.sort(drags.sound[different(drags.commands[drags.sound], strokes)])
    drawings = _coarse(drags, images)
    # A prior that is narrower by the root of a weight counts as much as ink of that weight.
    weight = STROKE_MM2 * float(drawings.x_mm[1] - drawings.x_mm[0]) ** 2
    known = drags.commands if prior.kept is None else np.array(prior.kept.commands)
    freedom = {name: sd * weight**0.5 for name, sd in session_change(known).items()}
    values, origin = fit_values(drawings, model_of(prior.parameters), freedom), f"{prior.session_id}, {prior.source}"
    about = {"prior": prior.digest, "prior_session": origin, "refitted": tuple(values)}
    return _artefact(drags, images, prior.parameters | values, **about)


def different(commands: Floats, count: int) -> Indices:
    """`count` rows of (B, 5) commands that are as different as possible, the most ordinary one first.

    With strokes of one kind, the model's error for that kind would look like a change of the brush's place. So would an
    error of one part of the page, with strokes made one after the other: their order counts as one more command.
    """
    ordered = np.column_stack([commands, np.arange(len(commands))])
    spread = ordered.std(axis=0)
    places = (ordered - ordered.mean(axis=0)) / np.where(spread > 1e-9, spread, np.inf)
    return np.array(farthest_first(places, int(np.linalg.norm(places, axis=1).argmin()), count))


def session_change(commands: Floats) -> dict[str, float]:
    """How far each parameter of a brush fitted to these (B, 5) commands may change (standard deviation)."""
    deepest = max(float(commands[:, COMMANDS.index("depth_mm")].max()), 1e-3)
    changes = SESSION_MM | {name: mm / deepest for name, mm in GROWTH_MM.items()}
    return {name: changes[name] for name in DragModel.names() if name in changes}


def _coarse(drags: Drags, images: Indices) -> Drawings:
    """These strokes with pixels of about `FIT_MM`."""
    return drags.drawings.only(images).every(max(1, round(FIT_MM / MM_PER_PX)))


def _artefact(drags: Drags, images: Indices, values: dict[str, FittedValue], **more: Any) -> DragArtefact:
    return DragArtefact(
        **drags.session.provenance,
        mm_per_px=MM_PER_PX,
        parameters=values,
        fitted_strokes=tuple(drags.placed[int(k)].stroke.stroke_id for k in images),
        **more,
    )


def _held_out(drags: Drags, progress: Progress) -> dict[str, tuple[float, float]]:
    """Scores on commands that were left out; empty for fewer than `FOLDS` of them."""
    conditions = drags.conditions
    order = np.random.default_rng(0).permutation(conditions.max() + 1)
    scores: dict[str, list[Floats]] = {}
    for k in counted(range(FOLDS if len(order) >= FOLDS else 0), "fifths of strokes left out in turn", FOLDS, progress):
        left = np.flatnonzero(np.isin(conditions, order[k::FOLDS]))
        others = np.setdiff1d(drags.sound, left)
        model = model_of(fit_values(_coarse(drags, others)))
        truth = drags.drawings.ink[left] > 0.5
        for name, seen in predicted(model, Kept.of(drags, others), drags, left).items():
            scores.setdefault(name, []).append(binary_scores(seen, truth))
    means = {name: 100.0 * np.concatenate(each).mean(axis=0) for name, each in scores.items()}
    return {name: (float(csim), float(iou)) for name, (csim, iou) in means.items()}
