"""One touch by force: fast down to a threshold, slowly around it, and a hinge fitted to the means at rest."""

from __future__ import annotations

import asyncio
import math
import statistics
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.errors import StepError
from brushloop.collect.motion import Procedures
from brushloop.collect.rig.config import ForceTouchConfig, TouchConfig
from brushloop.collect.touch.heights import Reach
from brushloop.drivers.devices import ForceSample

Floats = NDArray[np.float64]
SPRING_CHANGES = 0.05
"""Share by which a brush's stiffness may change from one touch to the next, as it dries or meets a leaning sheet."""


@dataclass(frozen=True, slots=True)
class Spring:
    """The brush's stiffness close to the paper, and its standard error."""

    n_mm: float
    sigma_n_mm: float

    def next(self) -> Spring:
        """The knowledge about the stiffness with which the next touch begins."""
        return Spring(self.n_mm, math.hypot(self.sigma_n_mm, SPRING_CHANGES * self.n_mm))


@dataclass(frozen=True, slots=True)
class Contact:
    """The height at which the force leaves zero."""

    z_mm: float
    sigma_mm: float
    """Standard error from the noise of the samples alone, without the error of taking the brush for a hinge."""
    spring: Spring


@dataclass(frozen=True, slots=True)
class Reading:
    """The arm at rest at a height, and the mean push there."""

    z_mm: float
    """The controller's height, not the commanded one."""
    force_n: float
    samples: int
    sd_n: float
    """Standard deviation of one sample."""
    run: int = 0
    """Number of the descent that it belongs to."""

    @property
    def least_n(self) -> float:
        """The least force there that counts as a push."""
        return max(THRESHOLD_N, FELT_SIGMAS * self.sd_n / math.sqrt(self.samples))


def find_contact(readings: Sequence[Reading], spring: Spring | None = None) -> Contact:
    """Least squares of force = offset + stiffness * max(0, contact - z) through means at rest.

    Each descent has its own offset, so that a slow drift of the sensor is not taken for force. `spring` is what earlier
    touches found; it counts as one more observation. The join is solved exactly between neighbouring heights (D. J.
    Hudson, Fitting segmented curves whose join points have to be estimated, J. Am. Stat. Assoc. 61, 1966).
    Raises `StepError` where the force does not rise over at least two heights, or one if the stiffness is known.
    """
    z_mm, force_n = np.array([r.z_mm for r in readings]), np.array([r.force_n for r in readings])
    weights, run = np.array([float(r.samples) for r in readings]), np.array([r.run for r in readings])
    variance_n2 = float(np.average([r.sd_n**2 for r in readings], weights=weights))
    heights = np.unique(z_mm)
    needed = 3 if spring is None else 2
    if len(heights) < needed or variance_n2 <= 0.0:
        raise StepError(f"forces at {len(heights)} heights do not give the contact; {needed} are needed")
    descents = np.unique(run)[:, None] == run[None, :]

    def free_of_offsets(rows: Floats) -> Floats:
        """(..., m) less each descent's weighted mean: what is left once the offsets have been fitted."""
        of = descents * weights
        means = rows @ of.T / of.sum(axis=1)
        return np.asarray(rows - means @ descents, np.float64)

    # An observation of the stiffness alone, in units of one sample.
    known = 0.0 if spring is None else variance_n2 / spring.sigma_n_mm**2
    known_n_mm = 0.0 if spring is None else known * spring.n_mm
    force = free_of_offsets(force_n)
    # (j, m): one row for each height but the highest, taken as the uppermost below the join.
    below = z_mm[None, :] <= heights[:-1, None]
    step, ramp = free_of_offsets(below.astype(np.float64)), free_of_offsets(np.where(below, -z_mm, 0.0))
    # Below the join, force = offset + stiffness * contact - stiffness * z, linear in both: 2 x 2 normal equations.
    ss, sr, rr = ((a * b) @ weights for a, b in ((step, step), (step, ramp), (ramp, ramp)))
    sf, rf = step @ (weights * force), ramp @ (weights * force) + known_n_mm
    rr = rr + known
    determinant = ss * rr - sr**2
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (rr * sf - sr * rf) / (ss * rf - sr * sf)
    solvable = (determinant > 1e-9 * ss * rr) & (inside >= heights[:-1]) & (inside <= heights[1:])
    joins = np.concatenate((inside[solvable], heights[1:]))
    springs = free_of_offsets(np.maximum(0.0, joins[:, None] - z_mm[None, :]))
    stretch, pull = (springs**2) @ weights + known, springs @ (weights * force) + known_n_mm
    # A force that falls on the way down is no contact, and one height below the join does not give a stiffness.
    least = 2 if spring is None else 1
    rises = (pull > 0.0) & (stretch > 1e-12) & ((heights[None, :] < joins[:, None]).sum(axis=1) >= least)
    if not rises.any():
        raise StepError("no contact: the force does not rise over at least two of the heights")
    squares = np.where(rises, -(pull**2) / np.where(rises, stretch, 1.0), np.inf)
    best = int(np.argmin(squares))
    contact, stiffness = float(joins[best]), float(pull[best] / stretch[best])
    moved = free_of_offsets(
        np.stack((stiffness * (z_mm < contact), np.maximum(0.0, contact - z_mm))).astype(np.float64)
    )
    variance = np.linalg.pinv((moved * weights) @ moved.T + np.diag((0.0, known)), hermitian=True) * variance_n2
    sigma_mm, sigma_n_mm = (math.sqrt(float(v)) for v in np.diag(variance))
    return Contact(contact, sigma_mm, Spring(stiffness, sigma_n_mm))


SLOW_MM = (-0.8, 0.08, 0.4)
"""Depths of the three rests of a slow descent. Two fix the hinge's arms, the middle one the join: a row of equal
steps needs more than twice the samples for the same error. The first is so high that it is in the air even where the
paper has risen since the last touch."""
SLOW_SHARES = (0.38, 0.42, 0.2)
LINEAR_MM = 0.45
"""Depth to which the brush counts as a linear spring; readings below it are left out."""
FAST_STEP_MM, MEDIUM_STEP_MM = 0.5, 0.15
THRESHOLD_N = 0.0012
"""Force that ends the fast approach: a soft brush pushes with a few mN in its first millimetre."""
MOST_SAMPLES = 60_000
"""Samples of one touch; if they are not enough, the sensor is too noisy for the brush."""
CLEAR_MM = 1.0
"""A rest above the previous one is approached from this much higher: every rest is reached on the way down."""
FELT_SIGMAS = 4.0
"""A mean force this many standard errors from zero is a push."""
LATE_STEPS = 2
"""Steps by which the fast approach may feel a soft brush too late."""
CLEAR_STEPS = 4
"""Number of rests in the air at the start of the medium approach."""
SPRING_SHARE = 0.1
"""Largest standard error of the stiffness, as a share of it, with which a touch ends."""
BESIDE_MM = 0.1
"""How far the last descent may have lain beside the contact: its rests must lie above and below it."""


Rest = Callable[[float, int], Awaitable[Reading]]
"""Brings a vertical brush to a height over one point of the sheet, to rest, and averages this many samples."""


async def touch_by_force(
    rest: Rest, reach: Reach, config: ForceTouchConfig, spring: Spring | None = None, near_z_mm: float | None = None
) -> Contact:
    """Touch once; the brush is left down.

    `spring` is what earlier touches found of the stiffness. With `near_z_mm`, the height of the last touch at this
    point, only the slow descents are left to do. Raises `StepError` if nothing is felt over the whole travel, if
    something is felt at its start, or if the noise leaves the contact unknown.
    """
    lowest_z_mm, highest_z_mm = reach.lowest_z_mm, reach.start_z_mm
    readings = list[Reading]()
    if near_z_mm is None:
        first = await rest(reach.start_z_mm, config.fast_samples)
        if abs(first.force_n) > first.least_n:
            raise StepError(
                f"the force is {1e3 * first.force_n:.1f} mN at the start of the approach, at {first.z_mm:.2f} mm: "
                "the brush touches already, or the sensor was not set to zero"
            )
        fast = await _until_felt(rest, reach.start_z_mm - FAST_STEP_MM, lowest_z_mm, FAST_STEP_MM, config.fast_samples)
        start_z_mm = fast[-1].z_mm + LATE_STEPS * FAST_STEP_MM + CLEAR_STEPS * MEDIUM_STEP_MM
        readings = await _until_felt(
            rest, start_z_mm, lowest_z_mm, MEDIUM_STEP_MM, config.medium_samples, clear=CLEAR_STEPS, in_a_row=2
        )
        highest_z_mm = start_z_mm + FAST_STEP_MM
        near_z_mm = fitted(readings, spring).z_mm
    run = 0
    while True:
        run += 1
        for depth_mm, share in zip(SLOW_MM, SLOW_SHARES, strict=True):
            z_mm = max(near_z_mm - depth_mm, lowest_z_mm)
            reading = await rest(z_mm, max(4, round(share * config.slow_samples)))
            readings.append(replace(reading, run=run))
        contact, samples = fitted(readings, spring), sum(reading.samples for reading in readings)
        # The standard error is computed from the stiffness. If that is uncertain, or if the descent lay beside the
        # contact, the true error can be much larger.
        sure = contact.spring.sigma_n_mm <= SPRING_SHARE * contact.spring.n_mm
        if sure and abs(contact.z_mm - near_z_mm) <= BESIDE_MM and contact.sigma_mm <= config.sigma_mm:
            if contact.z_mm > highest_z_mm:
                raise StepError(
                    f"the contact was found at {contact.z_mm:.2f} mm, but at {highest_z_mm:.2f} mm the brush was still "
                    "in the air: the sensor is too noisy for so few samples"
                )
            return contact
        if samples > MOST_SAMPLES:
            unsure = f"its height changed by more than {BESIDE_MM:g} mm with the last descent"
            if contact.sigma_mm > config.sigma_mm:
                unsure = f"its standard error is {contact.sigma_mm:.3f} mm, more than {config.sigma_mm:g} mm"
            if not sure:
                error = contact.spring.sigma_n_mm / contact.spring.n_mm
                unsure = f"the brush's stiffness is known only to within {error:.0%}, {SPRING_SHARE:.0%} is needed"
            raise StepError(
                f"the contact is not known well enough after {samples} samples of the force: {unsure}. The sensor is "
                "too noisy for this brush: look for vibration and a loose cable, or choose another touch.method"
            )
        near_z_mm = contact.z_mm


def fitted(readings: Sequence[Reading], spring: Spring | None) -> Contact:
    """Fit the hinge to the readings of the linear part; iterated, because that part depends on the hinge.

    More readings are kept where too few are left to give it: the descent lay too low, or they are noisy still.
    """

    contact = find_contact(readings, spring)
    for _ in range(3):
        lowest_z_mm = contact.z_mm - LINEAR_MM
        used = [reading for reading in readings if reading.z_mm >= lowest_z_mm]
        if not any(reading.z_mm < contact.z_mm for reading in used):
            break
        try:
            contact = find_contact(used, spring)
        except StepError:
            break
    return contact


async def _until_felt(
    rest: Rest, z_mm: float, lowest_z_mm: float, step_mm: float, samples: int, *, clear: int = 0, in_a_row: int = 1
) -> list[Reading]:
    """Go down in steps until something is felt at so many rests in a row, the first of which are `clear` of the paper.

    Raises `StepError` at the lowest height.
    """
    readings = list[Reading]()
    while True:
        z_mm = max(z_mm, lowest_z_mm)
        readings.append(await rest(z_mm, samples))
        last = readings[-in_a_row:]
        if len(readings) > clear and all(reading.force_n > reading.least_n for reading in last):
            return readings
        if z_mm <= lowest_z_mm + 1e-6:
            raise StepError(f"no contact was found down to {z_mm:.2f} mm, in steps of {step_mm:g} mm")
        z_mm -= step_mm


SILENT_S = 5.0
"""A sensor that sends nothing for this long has stopped. The arm rests meanwhile, so a busy computer is given time;
while the arm moves, `force.stale_ms` is the limit."""


Average = Callable[[int, tuple[float, float, float], int], Awaitable[tuple[float, float]]]
"""What `average` is of one sensor."""


async def average(
    listeners: list[Callable[[ForceSample], None]], samples: int, push_axis: tuple[float, float, float], after_ns: int
) -> tuple[float, float]:
    """(mean push in N, standard deviation of one sample) of the next samples received after `after_ns`.

    `listeners` are given every sample of the sensor, in the event loop. Raises `StepError` if the sensor falls silent.
    """
    arrived, pushes_n = asyncio.Queue[ForceSample](), list[float]()
    listeners.append(arrived.put_nowait)
    try:
        while len(pushes_n) < samples:
            async with asyncio.timeout(SILENT_S):
                sample = await arrived.get()
            if sample.stamp.host_ns > after_ns:
                along = zip(sample.force_n, push_axis, strict=True)
                pushes_n.append(sum(f * a for f, a in along) / math.hypot(*push_axis))
    except TimeoutError:
        raise StepError(f"the force sensor fell silent after {len(pushes_n)} of {samples} samples") from None
    finally:
        listeners.remove(arrived.put_nowait)
    return statistics.fmean(pushes_n), statistics.stdev(pushes_n)


def resting(procedures: Procedures, average: Average, at_mm: tuple[float, float], config: TouchConfig) -> Rest:
    """Rests over one point of the sheet, on a rig's arm and force sensor; each is reached from above."""
    last_z_mm = -math.inf

    async def rest(z_mm: float, samples: int) -> Reading:
        nonlocal last_z_mm
        if z_mm > last_z_mm > -math.inf:
            await procedures.lower(*at_mm, z_mm + CLEAR_MM, config.speed_mm_s)
        rests_z_mm = await procedures.lower(*at_mm, z_mm, config.speed_mm_s)
        last_z_mm = z_mm
        after_ns = procedures.rig.clock.now_ns() + round(config.force.settle_s * 1e9)
        force_n, sd_n = await average(samples, config.force.push_axis, after_ns)
        return Reading(rests_z_mm, force_n, samples, sd_n)

    return rest
