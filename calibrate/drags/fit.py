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
SPREADS = 2.2
"""Width of the kernel in standard deviations of each column of the training commands."""
TILT_SPREADS = 5.0
"""The same for the last column, the tilt, which matters little on real ink within 5 deg."""
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

    def distance(self, drawings: Drawings) -> Floats:
        """Signed distances of the marks of these paths, (B, len(y_mm), len(x_mm)) mm, positive in ink."""
        return marks_mm(self.model, drawings)

    def values(self) -> dict[str, FittedValue]:
        """All parameters, with intervals from a bootstrap over images; a draw is one Gauss-Newton step from the fit.

        Those that the strokes do not determine have no interval; with one image, none has. With fewer than about 8
        images the intervals are too short.
        """
        count, unit = len(self.squares), np.eye(len(self.scaled))
        share = np.full(count, 1.0 / count)
        weights = np.random.default_rng(0).multinomial(count, share, DRAWS).astype(np.float64)
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
    each = [
        ink_equations(
            nodes,
            starts,
            groups[k : k + 2],
            slopes,
            drawings.only(np.array([k])),
            spread_mm,
            None if added_mm is None else added_mm[k : k + 1],
        )
        for k in range(len(drawings.ink))
    ]
    squares, gradients = np.array([one.square for one in each]), np.array([one.gradient for one in each])
    return DragFit(DragModel.of(vector(scaled)), scaled, freedom, squares, gradients)


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
                    mm_per_px=round(float(drawings.x_mm[1] - drawings.x_mm[0]), 9),
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


@dataclass(frozen=True, slots=True)
class Correction:
    """What a drag model misses: a ridge over commands, on the grid of the strokes that it was learned from."""

    model: DragModel
    ridge: Ridge
    drawings: Drawings

    @staticmethod
    def fit(commands: Floats, drawings: Drawings, model: DragModel) -> Correction:
        """Learn what the model misses of these strokes."""
        captured = captured_distance(drawings.ink > 0.5, float(drawings.x_mm[1] - drawings.x_mm[0]))
        return Correction(model, Ridge.fit(commands, marks_mm(model, drawings), captured), drawings)

    def added_mm(self, commands: Floats, drawings: Drawings) -> Floats:
        """What it adds to clipped signed distances on a grid of the same scale, (B, rows, columns); 0 outside its own.

        The strokes of `drawings` have these commands, (B, 5).
        """
        x_mm, y_mm = self.drawings.x_mm, self.drawings.y_mm
        nodes, starts = trails(drawings.paths, self.model.vector())
        base = distances(nodes, starts, x_mm, y_mm)
        change = self.ridge.add(commands, base) - clipped(base)
        mm_per_px = float(x_mm[1] - x_mm[0])
        left = round((float(drawings.x_mm[0]) - float(x_mm[0])) / mm_per_px)
        top = round((float(y_mm[0]) - float(drawings.y_mm[0])) / mm_per_px)
        out = np.zeros((len(change), len(drawings.y_mm), len(drawings.x_mm)))
        rows = np.arange(max(0, -top), min(len(drawings.y_mm), len(y_mm) - top))
        columns = np.arange(max(0, -left), min(len(drawings.x_mm), len(x_mm) - left))
        out[:, rows[:, None], columns] = change[:, rows[:, None] + top, columns + left]
        return out


@dataclass(frozen=True, slots=True)
class Ridge:
    """A kernel ridge over (B, d) commands of images on one grid."""

    commands: Floats
    scales: Floats
    weights: NDArray[np.float32]
    """(B, h * w)."""

    @staticmethod
    def fit(commands: Floats, base_mm: Floats, captured_mm: Floats, ridge: float = RIDGE) -> Ridge:
        """Fit the captured signed distances minus the model's, both (B, h, w), as a function of (B, d) commands."""
        scales = scales_of(commands)
        missed = _flat(captured_mm) - _flat(base_mm)
        gram = _kernel(commands, commands, scales) + ridge * np.eye(len(commands))
        return Ridge(commands, scales, np.asarray(np.linalg.solve(gram, missed), np.float32))

    def add(self, commands: Floats, base_mm: Floats) -> Floats:
        """The model's signed distances (B, h, w), corrected."""
        found = _flat(base_mm) + _kernel(commands, self.commands, self.scales) @ self.weights
        return np.asarray(found, np.float64).reshape(base_mm.shape)


def threshold(commands: Floats, base_mm: Floats, captured_mm: Floats, stride: int = 2) -> float:
    """The probability above which a pixel is ink: half the mean CSIM of training strokes, each predicted from the
    strokes of other commands.

    `INK_ABOVE` for fewer than `LEAST` strokes.
    """
    if len(commands) < LEAST:
        return INK_ABOVE
    base, captured = (_flat(each[:, ::stride, ::stride]) for each in (base_mm, captured_mm))
    gram = _kernel(commands, commands, scales_of(commands)) + RIDGE * np.eye(len(commands))
    # The error of each row of a ridge that is fitted to the rows of other commands, in closed form.
    inverse = np.asarray(np.linalg.inv(gram), np.float64)
    errors = np.asarray(inverse @ (captured - base), np.float32)
    for rows in _repeats(commands):
        errors[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], errors[rows])
    predicted = ink((captured - errors).astype(np.float64), SPREAD_MM) > INK_ABOVE
    half = 0.5 * float(binary_scores(predicted, captured > 0.0)[:, 0].mean())
    return min(max(round(half, 3), LEAST_ABOVE), MOST_ABOVE)


def _repeats(commands: Floats) -> list[NDArray[np.int64]]:
    """The rows of each command."""
    number = np.unique(commands, axis=0, return_inverse=True)[1].ravel()
    return [np.flatnonzero(number == k) for k in range(int(number.max()) + 1)]


def scales_of(commands: Floats) -> Floats:
    """(d,) lengths of the kernel; a command that never changes has no influence."""
    spread = commands.std(axis=0)
    factors = np.full(commands.shape[1], SPREADS)
    factors[-1] = TILT_SPREADS
    return np.where(spread > 1e-9, factors * spread, 1e9)


def clipped(distance_mm: NDArray[np.floating]) -> NDArray[np.float32]:
    """Signed distance that levels off at `REACH_MM`."""
    return (REACH_MM * np.tanh(np.asarray(distance_mm, np.float32) / REACH_MM)).astype(np.float32)


def captured_distance(masks: NDArray[np.bool_], mm_per_px: float) -> Floats:
    """Signed distance to the edge of captured ink (n, rows, columns), positive inside, mm."""
    out: list[Floats] = []
    for k in range(len(masks)):
        mask: NDArray[np.bool_] = masks[k]
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        out.append(np.where(mask, inside, -outside) * mm_per_px)
    return np.array(out, np.float64)


def _flat(distance_mm: Floats) -> NDArray[np.float32]:
    return clipped(distance_mm).reshape(len(distance_mm), -1)


def _kernel(a: Floats, b: Floats, scales: Floats) -> Floats:
    return np.exp(-0.5 * (((a[:, None] - b[None]) / scales) ** 2).sum(axis=-1))
