"""Fit bristle lag and width of `model.drag` to dragged strokes, and learn what the lag misses.

The fit minimises the squared difference between captured ink and the model's probability of ink, with an edge that
varies by `SPREAD_MM` from stroke to stroke. This gives the best image on average, and so the best cosine similarity.
What the lag misses is learned from the training strokes by kernel ridge regression on clipped signed distances. The
probability above which a pixel counts as ink is half of the attainable Dice score, which maximises that score's
expectation: it is estimated from how strokes of other commands predict each stroke.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from brushloop.calibrate.artefact import FittedValue, Frozen
from brushloop.calibrate.drags.captures import COMMANDS, commanded_path
from brushloop.model.drag import (
    DragModel,
    Drawings,
    Floats,
    Indices,
    derivatives,
    distances,
    fit_to_ink,
    ink,
    ink_equations,
    trails,
)
from brushloop.model.similarity import binary_scores
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.messages import decode_gray

SPREAD_MM = 0.9
"""Default scale of the logistic: an edge that varies by 1.6 mm (standard deviation)."""
INK_ABOVE = 0.42
"""A pixel counts as ink above this probability: half of the attainable Dice score maximises its expectation."""
FREEDOM = dict(
    zip(DragModel.names(), (2.0, 0.2, 0.01, 3.0, 1.0, 4.0, 1.5, 1.5, 0.2, 0.2, 3.0, 3.0, 0.5, 0.5), strict=True)
)
"""Standard deviations of the prior: a parameter this far from its start costs as much as a pixel of wrong ink."""
LAGGING = ("leash_mm", "leash_per_mm", "land_mm", "back_mm", "front", "front_width")
CIRCLES = DragModel(leash_mm=0.0, leash_per_mm=0.0, front=0.0)
"""Circle stamps: the disc stays at the tip, except for drift; its width still settles along the path."""
CIRCLES_FREEDOM = {name: sd for name, sd in FREEDOM.items() if name not in LAGGING}
DRAWS = 500
UNDETERMINED = 0.5
"""A parameter keeps no interval if the strokes reduce the variance of its weak prior by less than this share."""
REACH_MM = 6.0
"""Distance at which signed distances level off, because far from the edge they carry no information."""
SPREADS = (2.2, 2.2, 2.2, 2.2, 5.0)
"""Width of the kernel in standard deviations of each of `COMMANDS` of the training strokes; the tilt matters little on
real ink within 5 deg."""
RIDGE = 1.0
LEAST_ABOVE, MOST_ABOVE = 0.3, 0.46
LEAST = 8
"""With fewer training strokes the threshold is not estimated."""
MOST_STROKES = 200
MOST_BYTES = 400_000
"""Largest size of the images of all training strokes in base64."""
Number = Annotated[float, Field(ge=-1e6, le=1e6)]


@dataclass(frozen=True, slots=True)
class DragFit:
    """A drag model fitted to strokes, with what its intervals need."""

    model: DragModel
    scaled: Floats
    """(P,) changes of the free parameters from their start, in standard deviations of the prior."""
    freedom: Mapping[str, float]
    """Standard deviations of the prior of the free parameters, by name."""
    squares: Floats
    """(images, P, P) scaled J'J of each image."""
    gradients: Floats
    """(images, P)."""

    def values(self) -> dict[str, FittedValue]:
        """All parameters, with intervals from a bootstrap over images; a draw is one Gauss-Newton step from the fit.

        Those that the strokes do not determine have no interval; with one image, none has. With fewer than about 8
        images the intervals are too short.
        """
        count, unit = len(self.squares), np.eye(len(self.scaled))
        weights = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), DRAWS).astype(np.float64)
        square = np.tensordot(weights, self.squares, 1) + unit
        steps = np.linalg.solve(square, -(weights @ self.gradients + self.scaled)[..., None])[..., 0]
        drawn = np.quantile(steps, [0.025, 0.975], axis=0)
        variance = np.diag(np.asarray(np.linalg.inv(self.squares.sum(axis=0) + unit), np.float64))
        found: dict[str, FittedValue] = {}
        for name, value in zip(DragModel.names(), self.model.vector().tolist(), strict=True):
            found[name] = FittedValue(value=value, low=None, high=None)
            if name in self.freedom:
                at = list(self.freedom).index(name)
                low, high = (value + self.freedom[name] * float(end) for end in drawn[:, at])
                if variance[at] < 1.0 - UNDETERMINED and low < high:
                    found[name] = FittedValue(value=value, low=low, high=high)
        return found


def marks_mm(model: DragModel, drawings: Drawings) -> Floats:
    """Signed distances of a model's marks, (B, len(y_mm), len(x_mm)) mm, positive in ink."""
    nodes, starts = trails(drawings.paths, model.vector())
    return distances(nodes, starts, drawings.x_mm, drawings.y_mm, drawings.groups)


def fit_drags(
    drawings: Drawings,
    *,
    start: DragModel | None = None,
    freedom: Mapping[str, float] = FREEDOM,
    spread_mm: float = SPREAD_MM,
    added_mm: Floats | None = None,
) -> DragFit:
    """Fit by Levenberg-Marquardt the parameters that `freedom` names, with the standard deviations of their prior.

    `added_mm` (B, len(y_mm), len(x_mm)) is added to the signed distances: what the model is known to miss.
    """
    begin = (start or DragModel()).vector()
    at = [DragModel.names().index(name) for name in freedom]
    sd = np.array(list(freedom.values()))

    def vector(scaled: Floats) -> Floats:
        values = begin.copy()
        values[at] += sd * scaled
        return values

    def trails_at(scaled: Floats) -> tuple[Floats, Indices, Indices]:
        return *trails(drawings.paths, vector(scaled)), drawings.groups

    scaled = fit_to_ink(trails_at, np.zeros(len(at)), drawings, spread_mm, added_mm).vector
    nodes, starts, groups = trails_at(scaled)
    slopes = derivatives(lambda values: trails_at(values)[0], scaled)
    squares, gradients = list[Floats](), list[Floats]()
    for k in range(len(drawings.ink)):
        image, added = drawings.only(np.array([k])), None if added_mm is None else added_mm[k : k + 1]
        equations = ink_equations(nodes, starts, groups[k : k + 2], slopes, image, spread_mm, added)
        squares.append(equations.square)
        gradients.append(equations.gradient)
    return DragFit(DragModel.of(vector(scaled)), scaled, freedom, np.array(squares), np.array(gradients))


@dataclass(frozen=True, slots=True)
class Correction:
    """What a drag model misses: a kernel ridge over commands, on the grid of the strokes that it was learned from."""

    commands: Floats
    """(B, 5) of the strokes that it was learned from."""
    weights: NDArray[np.float32]
    """(B, len(y_mm) * len(x_mm))."""
    x_mm: Floats
    y_mm: Floats

    @staticmethod
    def fit(commands: Floats, drawings: Drawings, model: DragModel) -> Correction:
        """Learn what the model misses of these strokes."""
        missed = _flat(captured_distance(drawings.ink > 0.5, _mm_per_px(drawings.x_mm)))
        missed -= _flat(marks_mm(model, drawings))
        weights = np.linalg.solve(_gram(commands), missed).astype(np.float32)
        return Correction(commands, weights, drawings.x_mm, drawings.y_mm)

    def added_mm(self, commands: Floats, x_mm: Floats, y_mm: Floats) -> Floats:
        """What it adds to clipped signed distances of (B, 5) commands on a grid of the same scale; 0 outside its own.

        Returns (B, len(y_mm), len(x_mm)).
        """
        change = _kernel(commands, self.commands, self.commands) @ self.weights
        change = change.reshape(len(change), len(self.y_mm), len(self.x_mm))
        left = round((float(x_mm[0]) - float(self.x_mm[0])) / _mm_per_px(self.x_mm))
        top = round((float(self.y_mm[0]) - float(y_mm[0])) / _mm_per_px(self.x_mm))
        out = np.zeros((len(change), len(y_mm), len(x_mm)))
        rows = np.arange(max(0, -top), min(len(y_mm), len(self.y_mm) - top))
        columns = np.arange(max(0, -left), min(len(x_mm), len(self.x_mm) - left))
        out[:, rows[:, None], columns] = change[:, rows[:, None] + top, columns + left]
        return out


class Kept(Frozen):
    """Commands and ink of the training strokes as an artefact holds them, and the model that they correct.

    The images have square pixels, rows from the top. Files come from elsewhere: sizes are checked.
    """

    commands: Annotated[
        list[Annotated[list[Number], Field(min_length=len(COMMANDS), max_length=len(COMMANDS))]],
        Field(min_length=1, max_length=MOST_STROKES),
    ]
    """`COMMANDS` of each stroke."""
    parameters: Annotated[list[Number], Field(min_length=14, max_length=14)]
    mm_per_px: Annotated[float, Field(ge=0.05, le=5.0)]
    left_mm: Number
    """Centre of the first column; the stroke starts at x = 0."""
    top_mm: Number
    """Centre of the first row, y upward."""
    ink: Annotated[str, Field(max_length=MOST_BYTES)]
    """All images below each other, as a PNG in base64."""

    @staticmethod
    def of(commands: Floats, drawings: Drawings, model: DragModel) -> Kept | None:
        """The strokes as they go into an artefact; None if they do not fit into one, however few are kept."""
        step = max(1, -(-len(commands) // MOST_STROKES))
        while len(commands[::step]) > 1:
            picture = 255 * (drawings.ink[::step] > 0.5).astype(np.uint8).reshape(-1, len(drawings.x_mm))
            data = base64.b64encode(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes())
            if len(data) <= MOST_BYTES:
                return Kept(
                    commands=np.round(commands[::step], 6).tolist(),
                    parameters=model.vector().tolist(),
                    mm_per_px=round(_mm_per_px(drawings.x_mm), 9),
                    left_mm=round(float(drawings.x_mm[0]), 6),
                    top_mm=round(float(drawings.y_mm[0]), 6),
                    ink=data.decode(),
                )
            step *= 2
        return None

    def correction(self) -> Correction:
        """The ridge, fitted again. Raises ValueError for ink that cannot be read."""
        try:
            picture = decode_gray(base64.b64decode(self.ink, validate=True), "ink")
        except (binascii.Error, SessionDamaged) as error:
            raise ValueError(f"ink cannot be read ({error})") from None
        count = len(self.commands)
        if picture.shape[0] % count:
            raise ValueError(f"ink of {picture.shape[0]} rows, expected those of {count} strokes")
        seen = (picture > 127).reshape(count, -1, picture.shape[1])
        x_mm = np.asarray(self.left_mm + np.arange(seen.shape[2]) * self.mm_per_px, np.float64)
        y_mm = np.asarray(self.top_mm - np.arange(seen.shape[1]) * self.mm_per_px, np.float64)
        paths = [commanded_path(*row[:4]) for row in self.commands]
        drawings = Drawings(paths, np.arange(count + 1), seen.astype(np.float32), x_mm, y_mm, np.ones(count))
        return Correction.fit(np.array(self.commands), drawings, DragModel.of(np.array(self.parameters)))


def threshold(commands: Floats, base_mm: Floats, captured_mm: Floats, stride: int = 2) -> float:
    """The probability above which a pixel is ink: half the mean CSIM of training strokes, each predicted from the
    strokes of other commands.

    `INK_ABOVE` for fewer than `LEAST` strokes.
    """
    if len(commands) < LEAST:
        return INK_ABOVE
    base, captured = (_flat(each[:, ::stride, ::stride]) for each in (base_mm, captured_mm))
    # The error of each row of a ridge that is fitted to the rows of other commands, in closed form.
    inverse = np.asarray(np.linalg.inv(_gram(commands)), np.float64)
    errors = np.asarray(inverse @ (captured - base), np.float32)
    command_of = np.unique(commands, axis=0, return_inverse=True)[1].ravel()
    for rows in (np.flatnonzero(command_of == k) for k in range(command_of.max() + 1)):
        errors[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], errors[rows])
    predicted = ink((captured - errors).astype(np.float64), SPREAD_MM) > INK_ABOVE
    half = 0.5 * float(binary_scores(predicted, captured > 0.0)[:, 0].mean())
    return min(max(round(half, 3), LEAST_ABOVE), MOST_ABOVE)


def clipped(distance_mm: NDArray[np.floating]) -> NDArray[np.float32]:
    """Signed distance that levels off at `REACH_MM`."""
    return (REACH_MM * np.tanh(np.asarray(distance_mm, np.float32) / REACH_MM)).astype(np.float32)


def captured_distance(masks: NDArray[np.bool_], mm_per_px: float) -> Floats:
    """Signed distance to the edge of captured ink (n, rows, columns), positive inside, mm."""

    def to_other(inked: NDArray[np.bool_]) -> list[cv2.typing.MatLike]:
        return [cv2.distanceTransform(each, cv2.DIST_L2, 5) - 0.5 for each in inked.astype(np.uint8)]

    return np.where(masks, np.array(to_other(masks)), -np.array(to_other(~masks))).astype(np.float64) * mm_per_px


def _flat(distance_mm: Floats) -> NDArray[np.float32]:
    return clipped(distance_mm).reshape(len(distance_mm), -1)


def _mm_per_px(x_mm: Floats) -> float:
    return float(x_mm[1] - x_mm[0])


def _gram(commands: Floats) -> Floats:
    return _kernel(commands, commands, commands) + RIDGE * np.eye(len(commands))


def _kernel(a: Floats, b: Floats, training: Floats) -> Floats:
    """The Gaussian kernel of (n, 5) and (m, 5) commands; one that never changes in training has no influence."""
    spread = training.std(axis=0)
    scales = np.where(spread > 1e-9, np.array(SPREADS) * spread, 1e9)
    return np.exp(-0.5 * (((a[:, None] - b[None]) / scales) ** 2).sum(axis=-1))
