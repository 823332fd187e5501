"""What a drag model misses, learned from its training strokes by kernel ridge regression on clipped signed distances.

The probability above which a pixel counts as ink is half of the attainable Dice score, which maximises that score's
expectation. It is estimated by how well each training stroke is predicted from those of other commands, in closed form
for a ridge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.similarity import binary_scores
from brushloop.calibrate.drags.fit import INK_ABOVE, SPREAD_MM
from brushloop.model.drag import ink

Floats = NDArray[np.float64]

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
