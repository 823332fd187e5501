"""Where a force leaves zero, and where ink begins: arrays in, a height with its standard error out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from collect.errors import StepError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Contact:
    """The height at which the force leaves zero."""

    z_mm: float
    sigma_mm: float
    """Standard error, from the noise of a sample; it holds nothing of what a hinge is not."""
    stiffness_n_mm: float
    misfit: float
    """Chi-square per degree of freedom: about 1 where the brush is a straight spring so near to the paper."""
    samples: int


def find_contact(
    z_mm: Floats, force_n: Floats, samples: NDArray[np.int64], sample_sd_n: float, run: NDArray[np.int64] | None = None
) -> Contact:
    """Least squares of force = offset + stiffness * max(0, contact - z) through means at rest.

    All arrays are (m,): height, mean force, how many samples it is the mean of, and which descent (0, 1, ...) it
    belongs to; each descent has an offset of its own, so that a slow drift of the sensor is no force. `sample_sd_n` is
    the standard deviation of one sample. The join is solved exactly between each two heights (D. J. Hudson, Fitting
    segmented curves whose join points have to be estimated, J. Am. Stat. Assoc. 61, 1966).
    Raises `StepError` where the force does not rise over two heights at least.
    """
    heights = np.unique(z_mm)
    if len(heights) < 3 or sample_sd_n <= 0.0:
        raise StepError(f"a contact needs rests at three heights or more, there are {len(heights)}")
    weights = samples.astype(np.float64)
    runs = np.zeros(len(z_mm), np.int64) if run is None else run
    descents = np.unique(runs)[:, None] == runs[None, :]

    def free_of_offsets(rows: Floats) -> Floats:
        """(..., m) less each descent's weighted mean: what is left of a column once the offsets have been fitted."""
        of = descents * weights
        means = rows @ of.T / of.sum(axis=1)
        return np.asarray(rows - means @ descents, np.float64)

    force = free_of_offsets(force_n)
    # Each height but the highest as the upper end of what lies below the join: (j, m).
    below = z_mm[None, :] <= heights[:-1, None]
    step, ramp = free_of_offsets(below.astype(np.float64)), free_of_offsets(np.where(below, -z_mm, 0.0))
    # force = offset + (stiffness * contact) below - stiffness * z below is linear in both: 2 x 2 normal equations
    ss, sr, rr = ((a * b) @ weights for a, b in ((step, step), (step, ramp), (ramp, ramp)))
    sf, rf = step @ (weights * force), ramp @ (weights * force)
    determinant = ss * rr - sr**2
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (rr * sf - sr * rf) / (ss * rf - sr * sf)
    solvable = (determinant > 1e-9 * ss * rr) & (inside >= heights[:-1]) & (inside <= heights[1:])
    joins = np.concatenate((inside[solvable], heights[1:]))
    springs = free_of_offsets(np.maximum(0.0, joins[:, None] - z_mm[None, :]))
    stretch, pull = (springs**2) @ weights, springs @ (weights * force)
    # a force that falls on the way down is no contact, and one height below the join does not tell a stiffness
    rises = (pull > 0.0) & (stretch > 1e-12) & ((heights[None, :] < joins[:, None]).sum(axis=1) >= 2)
    if not rises.any():
        raise StepError("no contact: the force does not rise over two of these heights")
    squares = np.where(rises, -(pull**2) / np.where(rises, stretch, 1.0), np.inf)
    best = int(np.argmin(squares))
    contact, stiffness = float(joins[best]), float(pull[best] / stretch[best])
    moved = free_of_offsets(
        np.stack((stiffness * (z_mm < contact), np.maximum(0.0, contact - z_mm))).astype(np.float64)
    )
    variance = np.linalg.pinv((moved * weights) @ moved.T, hermitian=True) * sample_sd_n**2
    freedom = max(len(z_mm) - len(descents) - 2, 1)
    left = float((force**2) @ weights + squares[best]) / sample_sd_n**2
    return Contact(contact, math.sqrt(variance[0, 0]), stiffness, left / freedom, int(samples.sum()))


@dataclass(frozen=True, slots=True)
class FirstInk:
    """Between which spots of a row the ink begins."""

    clean: int
    """Index of the last spot without ink."""
    inked: int
    """Index of the first one with ink; every spot after it has ink."""


def first_ink(ink_mm2: Floats, least_mm2: float) -> FirstInk:
    """Where the ink begins in a row of spots, (m,) from the highest to the lowest.

    Raises `StepError` where the first spot has ink, where none has, and where ink ends again further down: a brush
    that ran dry would else pass for one that did not touch.
    """
    seen = np.asarray(ink_mm2) >= least_mm2
    if not seen.any():
        raise StepError("no spot of the row left ink: nothing was touched")
    first = int(np.argmax(seen))
    if first == 0:
        raise StepError("the highest spot of the row has ink already: the paper lies higher than expected")
    if not seen[first:].all():
        missing = first + int(np.argmin(seen[first:]))
        raise StepError(f"spot {missing + 1} of the row left no ink though a higher one did: is the brush dry?")
    return FirstInk(first - 1, first)
