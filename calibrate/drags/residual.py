"""What a drag model misses, learned from its training strokes by kernel ridge regression on clipped signed distances.

Two ridges are mixed: one on the difference between captured and predicted distance, and one straight on the captured
distance. Their strengths, and the chance from which a pixel is called ink, are chosen by leaving out each training
stroke in turn, which a ridge gives in closed form. No other stroke takes part in the choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.drags.fit import INK_ABOVE, SPREAD_MM, chance

Floats = NDArray[np.float64]

REACH_MM = 6.0
"""Where the signed distance levels off: far from the edge it says nothing."""
SPREADS = 2.2
"""Width of the kernel in standard deviations of each column of the training commands."""
TILT_SPREADS = 5.0
"""The same for the last column, the tilt, which matters little on real ink within 5 deg."""
STRAIGHT_SPREADS, STRAIGHT_RIDGE = 0.5, 0.1
"""Width, relative to the other ridge's, and strength of the ridge straight on the distance."""
RIDGES = (1.0, 3.0, 10.0, 1e6)
"""Strengths to choose from: the last one leaves the model as it is."""
SHARES = (0.0, 0.25, 0.5)
"""Shares of the straight ridge to choose from."""
ABOVE = (0.30, 0.34, 0.38, 0.42, 0.46)
LEAST = 8
"""Fewer training strokes say too little about neighbours."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the left-out training strokes chose."""

    ridge: float = 1.0
    share: float = 0.0
    """Share of the straight ridge."""
    above: float = INK_ABOVE
    """A pixel counts as ink above this probability."""


@dataclass(frozen=True, slots=True)
class Residual:
    """Two fitted ridges over (B, d) commands, on one grid."""

    commands: Floats
    scales: Floats
    choice: Choice
    missed: NDArray[np.float32]
    """(B, h * w) weights of captured minus predicted distance."""
    straight: NDArray[np.float32]
    """(B, h * w) weights of the captured distance less `middle`; empty if its share is 0."""
    middle: NDArray[np.float32]

    @staticmethod
    def fit(commands: Floats, base_mm: Floats, captured_mm: Floats, choice: Choice | None = None) -> Residual:
        """Fit to (B, d) commands and to the model's and the captured signed distances (B, h, w).

        Without a `choice`, the strengths are chosen by `choose`.
        """
        taken = choose(commands, base_mm, captured_mm) if choice is None else choice
        base, captured = _flat(base_mm), _flat(captured_mm)
        scales = scales_of(commands)
        missed = _solved(_gram(commands, scales, taken.ridge), captured - base)
        middle = captured.mean(axis=0)
        straight = np.zeros((0, base.shape[1]), np.float32)
        if taken.share > 0.0:
            gram = _gram(commands, scales * STRAIGHT_SPREADS, STRAIGHT_RIDGE)
            straight = _solved(gram, captured - middle)
        return Residual(commands, scales, taken, missed, straight, middle)

    def add(self, commands: Floats, base_mm: Floats) -> Floats:
        """The corrected signed distances, (B, h, w), of the model's."""
        base = _flat(base_mm)
        found = base + _kernel(commands, self.commands, self.scales) @ self.missed
        if self.choice.share > 0.0:
            kernel = _kernel(commands, self.commands, self.scales * STRAIGHT_SPREADS)
            found = (1.0 - self.choice.share) * found + self.choice.share * (self.middle + kernel @ self.straight)
        return np.asarray(found, np.float64).reshape(base_mm.shape)


def choose(
    commands: Floats, base_mm: Floats, captured_mm: Floats, stride: int = 2, spread_mm: float = SPREAD_MM
) -> Choice:
    """The strengths with the best mean CSIM over the training strokes, each predicted from the others."""
    every = (slice(None), slice(None, None, stride), slice(None, None, stride))
    base, captured = _flat(base_mm[every]), _flat(captured_mm[every])
    if len(commands) < LEAST:
        return Choice(ridge=RIDGES[-1])
    truth, scales = captured > 0.0, scales_of(commands)
    centred = captured - captured.mean(axis=0)
    straight = captured - _left_out(_gram(commands, scales * STRAIGHT_SPREADS, STRAIGHT_RIDGE), centred)
    found: list[tuple[float, Choice]] = []
    for ridge in RIDGES:
        corrected = captured - _left_out(_gram(commands, scales, ridge), captured - base)
        for share in SHARES:
            seen = chance((1.0 - share) * corrected + share * straight, spread_mm)
            found += [(_csim(seen > above, truth), Choice(ridge, share, above)) for above in ABOVE]
    return max(found, key=lambda one: one[0])[1]


def scales_of(commands: Floats) -> Floats:
    """(d,) lengths of the kernel; a command that never changes has no influence."""
    spread = commands.std(axis=0)
    factors = np.full(commands.shape[1], SPREADS)
    factors[-1] = TILT_SPREADS
    return np.where(spread > 1e-9, factors * spread, 1e9)


def clipped(distance_mm: NDArray[np.floating]) -> NDArray[np.float32]:
    """Signed distance that levels off at `REACH_MM`."""
    return (REACH_MM * np.tanh(np.asarray(distance_mm, np.float32) / REACH_MM)).astype(np.float32)


def captured_distance(ink: NDArray[np.bool_] | Sequence[NDArray[np.bool_]], mm_per_px: float) -> Floats:
    """Signed distance to the edge of captured ink, positive inside, (n, rows, columns) mm."""
    out: list[Floats] = []
    for mask in ink:
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        out.append(np.where(mask, inside, -outside) * mm_per_px)
    return np.array(out, np.float64)


def _flat(distance_mm: Floats) -> NDArray[np.float32]:
    return clipped(distance_mm).reshape(len(distance_mm), -1)


def _gram(commands: Floats, scales: Floats, ridge: float) -> Floats:
    return _kernel(commands, commands, scales) + ridge * np.eye(len(commands))


def _left_out(gram: Floats, target: NDArray[np.float32]) -> NDArray[np.float32]:
    """By how much each row of `target` is missed if a ridge is fitted to the others."""
    inverse = np.asarray(np.linalg.solve(gram, np.eye(len(gram))), np.float64)
    return np.asarray((inverse @ target) / np.diag(inverse)[:, None], np.float32)


def _solved(gram: Floats, target: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.linalg.solve(gram, target), np.float32)


def _csim(seen: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    both = (seen & truth).sum(axis=1, dtype=np.float64)
    norm = np.sqrt(seen.sum(axis=1, dtype=np.float64) * truth.sum(axis=1, dtype=np.float64))
    return float((both / np.maximum(norm, 1e-9)).mean())


def _kernel(a: Floats, b: Floats, scales: Floats) -> Floats:
    return np.exp(-0.5 * (((a[:, None] - b[None]) / scales) ** 2).sum(axis=-1))
