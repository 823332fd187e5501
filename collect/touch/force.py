"""One touch by force: fast down to a threshold, slowly around it, and a hinge fitted to the means at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from collect.errors import StepError
from collect.rig.config_touch import ForceTouchConfig
from collect.touch.heights import Reach

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Contact:
    """The height at which the force leaves zero."""

    z_mm: float
    sigma_mm: float
    """Standard error from the noise of the samples alone, without the error of taking the brush for a hinge."""
    stiffness_n_mm: float
    misfit: float
    """Chi-square per degree of freedom: about 1 if the brush is a linear spring this near to the paper."""
    samples: int


def find_contact(
    z_mm: Floats, force_n: Floats, samples: NDArray[np.int64], sample_sd_n: float, run: NDArray[np.int64] | None = None
) -> Contact:
    """Least squares of force = offset + stiffness * max(0, contact - z) through means at rest.

    All arrays are (m,): height, mean force, number of samples in the mean, and descent (0, 1, ...) that it belongs to.
    Each descent has its own offset, so that a slow drift of the sensor is not taken for force. `sample_sd_n` is the
    standard deviation of one sample. The join is solved exactly between neighbouring heights (D. J. Hudson, Fitting
    segmented curves whose join points have to be estimated, J. Am. Stat. Assoc. 61, 1966).
    Raises `StepError` where the force does not rise over at least two heights.
    """
    heights = np.unique(z_mm)
    if len(heights) < 3 or sample_sd_n <= 0.0:
        raise StepError(f"a contact needs rests at three heights or more, there are {len(heights)}")
    weights = samples.astype(np.float64)
    runs = np.zeros(len(z_mm), np.int64) if run is None else run
    descents = np.unique(runs)[:, None] == runs[None, :]

    def free_of_offsets(rows: Floats) -> Floats:
        """(..., m) less each descent's weighted mean: what is left once the offsets have been fitted."""
        of = descents * weights
        means = rows @ of.T / of.sum(axis=1)
        return np.asarray(rows - means @ descents, np.float64)

    force = free_of_offsets(force_n)
    # (j, m): one row for each height but the highest, taken as the uppermost below the join.
    below = z_mm[None, :] <= heights[:-1, None]
    step, ramp = free_of_offsets(below.astype(np.float64)), free_of_offsets(np.where(below, -z_mm, 0.0))
    # Below the join, force = offset + stiffness * contact - stiffness * z, linear in both: 2 x 2 normal equations.
    ss, sr, rr = ((a * b) @ weights for a, b in ((step, step), (step, ramp), (ramp, ramp)))
    sf, rf = step @ (weights * force), ramp @ (weights * force)
    determinant = ss * rr - sr**2
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (rr * sf - sr * rf) / (ss * rf - sr * sf)
    solvable = (determinant > 1e-9 * ss * rr) & (inside >= heights[:-1]) & (inside <= heights[1:])
    joins = np.concatenate((inside[solvable], heights[1:]))
    springs = free_of_offsets(np.maximum(0.0, joins[:, None] - z_mm[None, :]))
    stretch, pull = (springs**2) @ weights, springs @ (weights * force)
    # A force that falls on the way down is no contact, and one height below the join does not give a stiffness.
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


SLOW_MM = (-0.15, 0.08, 0.4)
"""Depths of the three rests of a slow descent. Two fix the hinge's arms, the middle one the join: a row of equal
steps needs more than twice the samples for the same error."""
SLOW_SHARES = (0.38, 0.42, 0.2)
FELT_SIGMAS = 4.0
"""A mean force this many standard errors from zero is a push."""
LATE_STEPS = 2
"""Steps by which the fast approach may feel a soft brush too late."""
CLEAR_STEPS = 4
"""Number of rests in the air at the start of the medium approach."""
ROUGH_RUN = 0


@dataclass(frozen=True, slots=True)
class Reading:
    """The arm at rest at a height, and the mean push there."""

    z_mm: float
    """The controller's height, not the commanded one."""
    force_n: float
    samples: int
    sd_n: float
    """Standard deviation of one sample."""


class Probe(Protocol):
    """A vertical brush over one point of the sheet."""

    async def rest(self, z_mm: float, samples: int) -> Reading:
        """Go to the height, come to rest, and average this many samples."""
        ...


@dataclass(slots=True)
class _Log:
    """The readings of one touch so far."""

    readings: list[tuple[Reading, int]] = field(default_factory=list[tuple[Reading, int]])

    @property
    def samples(self) -> int:
        return sum(reading.samples for reading, _ in self.readings)

    def contact(self, config: ForceTouchConfig) -> Contact:
        """Fit the hinge to the readings of the linear part; iterated, because that part depends on the hinge."""
        found = self._fit(-math.inf)
        for _ in range(3):
            found = self._fit(found.z_mm - config.linear_mm)
        return found

    def _fit(self, lowest_z_mm: float) -> Contact:
        used = [(r, run) for r, run in self.readings if r.z_mm >= lowest_z_mm]
        total = sum(r.samples for r, _ in used)
        sd_n = math.sqrt(sum(r.samples * r.sd_n**2 for r, _ in used) / total)
        return find_contact(
            np.array([r.z_mm for r, _ in used]),
            np.array([r.force_n for r, _ in used]),
            np.array([r.samples for r, _ in used]),
            sd_n,
            np.array([run for _, run in used]),
        )


async def touch_by_force(
    probe: Probe, reach: Reach, config: ForceTouchConfig, near_z_mm: float | None = None
) -> Contact:
    """Touch once; the probe is left down.

    `near_z_mm` is the height of the last touch, and makes the fast approach unnecessary. Raises `StepError` if nothing
    is felt over the whole travel, if something is felt at its start, or if the noise leaves the contact unknown.
    """
    lowest_z_mm = reach.lowest_z_mm
    if near_z_mm is None:
        felt_z_mm = await _fast(probe, reach.start_z_mm, lowest_z_mm, config)
        near_z_mm = felt_z_mm + LATE_STEPS * config.fast_step_mm
    log = await _medium(probe, near_z_mm + CLEAR_STEPS * config.medium_step_mm, lowest_z_mm, config)
    run = ROUGH_RUN
    contact = log.contact(config)
    while run == ROUGH_RUN or contact.sigma_mm > config.sigma_mm:
        if log.samples > config.max_samples:
            raise StepError(
                f"the contact is known to {contact.sigma_mm:.3f} mm only after {log.samples} samples of the force, "
                f"{config.sigma_mm:g} mm are asked for: the sensor is too noisy for this brush"
            )
        run += 1
        for depth_mm, share in zip(SLOW_MM, SLOW_SHARES, strict=True):
            samples = max(4, round(share * config.slow_samples))
            z_mm = max(contact.z_mm - depth_mm, lowest_z_mm)
            log.readings.append((await probe.rest(z_mm, samples), run))
        contact = log.contact(config)
    return contact


async def _fast(probe: Probe, start_z_mm: float, lowest_z_mm: float, config: ForceTouchConfig) -> float:
    """Go down in large steps; return the height of the first rest at which something is felt."""
    z_mm, reading = start_z_mm, await probe.rest(start_z_mm, config.fast_samples)
    felt_n = _felt_n(reading, config)
    if abs(reading.force_n) > felt_n:
        raise StepError(
            f"the force is {1e3 * reading.force_n:.1f} mN at the start of the approach, at {start_z_mm:.2f} mm: "
            "the brush touches already, or the sensor was not set to zero"
        )
    while z_mm > lowest_z_mm + 1e-6:
        z_mm = max(z_mm - config.fast_step_mm, lowest_z_mm)
        if (await probe.rest(z_mm, config.fast_samples)).force_n > felt_n:
            return z_mm
    raise StepError(f"nothing was touched down to {lowest_z_mm:.2f} mm: the force stayed below {1e3 * felt_n:.1f} mN")


async def _medium(probe: Probe, start_z_mm: float, lowest_z_mm: float, config: ForceTouchConfig) -> _Log:
    """Go down in smaller steps until something is felt at two rests in a row."""
    log, z_mm, before_n = _Log(), start_z_mm, 0.0
    while True:
        reading = await probe.rest(z_mm, config.medium_samples)
        log.readings.append((reading, ROUGH_RUN))
        if min(before_n, reading.force_n) > _felt_n(reading, config) and len(log.readings) > CLEAR_STEPS:
            return log
        if z_mm <= lowest_z_mm + 1e-6:
            raise StepError(f"nothing was touched down to {z_mm:.2f} mm, in steps of {config.medium_step_mm:g} mm")
        z_mm, before_n = max(z_mm - config.medium_step_mm, lowest_z_mm), reading.force_n


def _felt_n(reading: Reading, config: ForceTouchConfig) -> float:
    return max(config.threshold_n, FELT_SIGMAS * reading.sd_n / math.sqrt(reading.samples))
