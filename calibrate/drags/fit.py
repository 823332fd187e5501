"""Fit bristle lag and width of `model.drag` to dragged strokes, and learn what the lag misses.

The fit minimises the squared difference between captured ink and the model's probability of ink, with an edge that
varies by `SPREAD_MM` from stroke to stroke. This gives the best image on average, and so the best cosine similarity.
Optional columns for each stroke (its place on the page) shift the whole stroke, by the error of the calibration of
arm against camera there. What the lag misses is learned from the training strokes by kernel ridge regression on
clipped signed distances. The probability above which a pixel counts as ink is half of the attainable Dice score,
which maximises that score's expectation: it is estimated from how strokes of other commands predict each stroke.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.score import binary_scores
from brushloop.model.damped import Damping, Equations, descend
from brushloop.model.drag import DragModel, distances, ink, trails

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

SPREAD_MM = 0.9
"""Default scale of the logistic: an edge that varies by 1.6 mm (standard deviation)."""
INK_ABOVE = 0.42
"""A pixel counts as ink above this probability: half of the attainable Dice score maximises its expectation."""
PRIOR = (2.0, 0.2, 0.01, 3.0, 1.0, 4.0, 1.5, 1.5, 0.2, 0.2, 3.0, 3.0, 0.5, 0.5)
"""Standard deviations of the prior: a parameter this far from its start costs as much as a pixel of wrong ink."""
PLACE_PRIOR_MM = 1.5
ROUNDS = 25
DAMPING = Damping(1e-2, 5.0, 6.0, 1e-6, 1e4, floor=0.0)
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


@dataclass(frozen=True, slots=True)
class DragFit:
    """A drag model fitted to strokes, and how the fit went."""

    model: DragModel
    place_mm: Floats
    """(q, 2) shift of a stroke in x and y for each column of its place."""
    condition: float
    """Condition number of the scaled normal equations: above about 1e4 the parameters cannot be distinguished."""
    cost: float
    spread_mm: float = SPREAD_MM
    """Variation of an edge from stroke to stroke (scale of the logistic)."""

    centre: Floats = field(default_factory=lambda: DragModel().vector())
    """(14,) parameters that the prior pulls towards."""
    scale: Floats = field(default_factory=lambda: np.array(PRIOR))
    """(14,) standard deviations of the prior."""
    squares: Floats = field(default_factory=lambda: np.zeros((0, 0, 0)))
    """(images, P, P) scaled J'J of each image at the end, for the P free parameters."""
    gradients: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    free: tuple[str, ...] = ()

    def distance(
        self,
        paths: Sequence[Floats],
        x_mm: Floats,
        y_mm: Floats,
        place: Floats | None = None,
        groups: Indices | None = None,
    ) -> Floats:
        """Signed distances of the marks of these paths, (B, len(y_mm), len(x_mm)) mm, positive in ink."""
        nodes, starts = trails(paths, self.model.vector())
        each = _each(paths, groups)
        along = None if place is None else np.repeat(place, np.diff(each), axis=0)
        return distances(_shifted(nodes, starts, along, self.place_mm), starts, x_mm, y_mm, each)


def fit_drags(
    paths: Sequence[Floats],
    target: NDArray[np.generic],
    x_mm: Floats,
    y_mm: Floats,
    place: Floats | None = None,
    *,
    start: DragModel | None = None,
    lag: bool = True,
    spread_mm: float = SPREAD_MM,
    groups: Indices | None = None,
    weights: Floats | None = None,
    only: Mapping[str, float] | None = None,
    added_mm: Floats | None = None,
) -> DragFit:
    """Fit by Levenberg-Marquardt to (B, len(y_mm), len(x_mm)) ink; `place` is (B, q).

    Paths `groups[i]` to `groups[i + 1]` are the strokes of image i; without `groups` each image shows one stroke.
    Without `lag` the disc stays at the tip, except for drift; its width still settles along the path. `weights` are one
    for each image. `only` names the parameters that are fitted, and how far each may be from `start`. `added_mm`
    (B, len(y_mm), len(x_mm)) is added to the signed distances: what the model is known to miss.
    Raises ValueError if the sizes of paths, ink and place do not match.
    """
    from brushloop.model import drag_kernel

    kernel: Any = drag_kernel

    images = np.ascontiguousarray(target, np.float32)
    each = _each(paths, groups)
    shown = len(each) - 1
    if images.shape != (shown, len(y_mm), len(x_mm)) or (place is not None and len(place) != shown):
        raise ValueError(f"{shown} strokes or figures, ink {images.shape}, grid ({len(y_mm)}, {len(x_mm)}): not alike")
    columns = np.zeros((len(paths), 0)) if place is None else np.repeat(place, np.diff(each), axis=0).astype(np.float64)
    begin = start or (DragModel() if lag else DragModel(leash_mm=0.0, leash_per_mm=0.0, front=0.0))
    first = np.concatenate([begin.vector(), np.zeros(2 * columns.shape[1])])
    prior = np.array([(only or {}).get(name, sd) for name, sd in zip(DragModel.names(), PRIOR, strict=True)])
    scale = np.concatenate([prior, np.full(2 * columns.shape[1], PLACE_PRIOR_MM)])
    added = np.zeros((1, *images.shape[1:])) if added_mm is None else np.ascontiguousarray(added_mm, np.float64)
    counted = np.ones(shown) if weights is None else np.asarray(weights, np.float64)
    free = np.ones(len(first), np.bool_)
    if only is not None:
        free[:14] = [name in only for name in DragModel.names()]
    elif not lag:
        held = ("leash_mm", "leash_per_mm", "land_mm", "back_mm", "front", "front_width")
        free[[DragModel.names().index(name) for name in held]] = False

    def whole(part: Floats) -> Floats:
        vector = first.copy()
        vector[free] = part
        return vector

    def equations(part: Floats) -> Equations:
        vector = whole(part)
        nodes, starts, slopes = _linearised(paths, vector, scale, columns)
        square, gradient = np.zeros((len(vector), len(vector))), np.zeros(len(vector))
        cost = float(
            kernel.normal_equations(
                nodes, starts, each, slopes, x_mm, y_mm, images, added, counted, spread_mm, square, gradient
            )
        )
        off = (vector - first) / scale
        square = np.tril(square) + np.tril(square, -1).T + np.eye(len(vector))
        return Equations(cost + 0.5 * float(off @ off), square[np.ix_(free, free)], (gradient + off)[free])

    found = descend(equations, first[free], rounds=ROUNDS, most=2.0, gain=1e-4, scale=scale[free], damping=DAMPING)
    vector, square = whole(found.vector), found.at.square
    spread = np.sqrt(np.diag(square))
    condition = float(np.linalg.cond(square / np.outer(spread, spread)))
    squares, gradients = _by_image(paths, each, images, added, counted, x_mm, y_mm, vector, scale, columns, spread_mm)
    names = tuple(name for name, is_free in zip(DragModel.names(), free, strict=False) if is_free)
    return DragFit(
        DragModel.of(vector[:14]),
        vector[14:].reshape(-1, 2),
        condition,
        found.at.cost,
        spread_mm,
        begin.vector(),
        prior,
        squares[:, free][:, :, free],
        gradients[:, free],
        names,
    )


def bootstrap(fit: DragFit, draws: int = 500, seed: int = 0) -> Floats:
    """(draws, P) values of the free parameters, by bootstrap over images; a draw is one Gauss-Newton step from the fit.

    With fewer than about 8 images the intervals are too short.
    """
    at = [DragModel.names().index(name) for name in fit.free]
    scale, found = fit.scale[at], fit.model.vector()[at]
    off = (found - fit.centre[at]) / scale
    count, total = len(fit.squares), fit.squares.shape[1]
    weights = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), draws).astype(np.float64)
    prior = np.zeros((draws, total))
    prior[:, : len(at)] = off
    square = np.tensordot(weights, fit.squares, 1) + np.eye(total)
    steps = np.asarray(np.linalg.solve(square, -(weights @ fit.gradients + prior)[..., None]), np.float64)[..., 0]
    return found + scale * steps[:, : len(at)]


def determined(fit: DragFit) -> NDArray[np.bool_]:
    """(P,) whether the strokes determine each free parameter, rather than the prior."""
    unit = np.eye(fit.squares.shape[1])
    variance = np.asarray(np.linalg.solve(fit.squares.sum(axis=0) + unit, unit), np.float64)
    return np.diag(variance)[: len(fit.free)] < 1.0 - UNDETERMINED


def _each(paths: Sequence[Floats], groups: Indices | None) -> Indices:
    return np.arange(len(paths) + 1) if groups is None else np.asarray(groups, np.int64)


def _by_image(
    paths: Sequence[Floats],
    each: Indices,
    images: NDArray[np.float32],
    added: Floats,
    weights: Floats,
    x_mm: Floats,
    y_mm: Floats,
    vector: Floats,
    scale: Floats,
    columns: Floats,
    spread_mm: float,
) -> tuple[Floats, Floats]:
    from brushloop.model import drag_kernel

    kernel: Any = drag_kernel
    nodes, starts, slopes = _linearised(paths, vector, scale, columns)
    size = len(vector)
    squares, gradients = np.zeros((len(images), size, size)), np.zeros((len(images), size))
    for i in range(len(images)):
        one = each[i : i + 2]
        kernel.normal_equations(
            nodes,
            starts,
            one,
            slopes,
            x_mm,
            y_mm,
            images[i : i + 1],
            added[i : i + 1] if len(added) > 1 else added,
            weights[i : i + 1],
            spread_mm,
            squares[i],
            gradients[i],
        )
        squares[i] = np.tril(squares[i]) + np.tril(squares[i], -1).T
    return squares, gradients


def _shifted(nodes: Floats, starts: NDArray[np.int64], place: Floats | None, by: Floats) -> Floats:
    if place is None or not len(by):
        return nodes
    out = nodes.copy()
    out[:, :2] += np.repeat(place @ by, np.diff(starts), axis=0)
    return out


def _linearised(
    paths: Sequence[Floats], vector: Floats, scale: Floats, columns: Floats
) -> tuple[Floats, NDArray[np.int64], Floats]:
    """The trails and their derivatives by the scaled parameters, (nodes, 3, P)."""
    nodes, starts = trails(paths, vector[:14])
    slopes = np.zeros((len(nodes), 3, len(vector)))
    for k in range(14):
        ahead = vector[:14].copy()
        ahead[k] += 1e-5 * scale[k]
        slopes[:, :, k] = (trails(paths, ahead)[0] - nodes) / 1e-5
    spread = np.repeat(columns, np.diff(starts), axis=0)
    for q in range(columns.shape[1]):
        slopes[:, 0, 14 + 2 * q] = slopes[:, 1, 15 + 2 * q] = PLACE_PRIOR_MM * spread[:, q]
    return _shifted(nodes, starts, columns, vector[14:].reshape(-1, 2)), starts, slopes


@dataclass(frozen=True, slots=True)
class Residual:
    """A ridge over (B, d) commands, on one grid."""

    commands: Floats
    scales: Floats
    weights: NDArray[np.float32]
    """(B, h * w)."""

    @staticmethod
    def fit(commands: Floats, base_mm: Floats, captured_mm: Floats, ridge: float = RIDGE) -> Residual:
        """Fit the captured signed distances minus the model's, both (B, h, w), as a function of (B, d) commands."""
        scales = scales_of(commands)
        return Residual(commands, scales, _solved(_gram(commands, scales, ridge), _flat(captured_mm) - _flat(base_mm)))

    def add(self, commands: Floats, base_mm: Floats) -> Floats:
        """The model's signed distances (B, h, w), corrected."""
        found = _flat(base_mm) + _kernel(commands, self.commands, self.scales) @ self.weights
        return np.asarray(found, np.float64).reshape(base_mm.shape)


def threshold(
    commands: Floats, base_mm: Floats, captured_mm: Floats, stride: int = 2, spread_mm: float = SPREAD_MM
) -> float:
    """The probability above which a pixel is ink: half the mean CSIM of training strokes, each predicted from the
    strokes of other commands.

    `INK_ABOVE` for fewer than `LEAST` strokes.
    """
    if len(commands) < LEAST:
        return INK_ABOVE
    every = (slice(None), slice(None, None, stride), slice(None, None, stride))
    base, captured = _flat(base_mm[every]), _flat(captured_mm[every])
    gram = _gram(commands, scales_of(commands), RIDGE)
    corrected = captured - _left_out(gram, captured - base, np.unique(commands, axis=0, return_inverse=True)[1])
    found = binary_scores(ink(corrected.astype(np.float64), spread_mm) > INK_ABOVE, captured > 0.0)
    half = 0.5 * float(found[:, 0].mean())
    return min(max(round(half, 3), LEAST_ABOVE), MOST_ABOVE)


def scales_of(commands: Floats) -> Floats:
    """(d,) lengths of the kernel; a command that never changes has no influence."""
    spread = commands.std(axis=0)
    factors = np.full(commands.shape[1], SPREADS)
    factors[-1] = TILT_SPREADS
    return np.where(spread > 1e-9, factors * spread, 1e9)


def clipped(distance_mm: NDArray[np.floating]) -> NDArray[np.float32]:
    """Signed distance that levels off at `REACH_MM`."""
    return (REACH_MM * np.tanh(np.asarray(distance_mm, np.float32) / REACH_MM)).astype(np.float32)


def captured_distance(masks: NDArray[np.bool_] | Sequence[NDArray[np.bool_]], mm_per_px: float) -> Floats:
    """Signed distance to the edge of captured ink, positive inside, (n, rows, columns) mm."""
    out: list[Floats] = []
    for mask in masks:
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        out.append(np.where(mask, inside, -outside) * mm_per_px)
    return np.array(out, np.float64)


def _flat(distance_mm: Floats) -> NDArray[np.float32]:
    return clipped(distance_mm).reshape(len(distance_mm), -1)


def _gram(commands: Floats, scales: Floats, ridge: float) -> Floats:
    return _kernel(commands, commands, scales) + ridge * np.eye(len(commands))


def _left_out(gram: Floats, target: NDArray[np.float32], conditions: NDArray[np.int64]) -> NDArray[np.float32]:
    """The error in each row of `target` of a ridge that is fitted to the rows of other conditions."""
    inverse = np.asarray(np.linalg.solve(gram, np.eye(len(gram))), np.float64)
    errors = np.asarray(inverse @ target, np.float32)
    for rows in (np.flatnonzero(conditions == condition) for condition in np.unique(conditions)):
        errors[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], errors[rows])
    return errors


def _solved(gram: Floats, target: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.linalg.solve(gram, target), np.float32)


def _kernel(a: Floats, b: Floats, scales: Floats) -> Floats:
    return np.exp(-0.5 * (((a[:, None] - b[None]) / scales) ** 2).sum(axis=-1))
