"""One touch by force: fast down to a threshold, slowly around it, and a hinge fitted to the means at rest."""

from __future__ import annotations

import asyncio
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

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


def find_contact(
    z_mm: Floats,
    force_n: Floats,
    samples: NDArray[np.int64],
    sample_sd_n: float,
    run: NDArray[np.int64] | None = None,
    spring: Spring | None = None,
) -> Contact:
    """Least squares of force = offset + stiffness * max(0, contact - z) through means at rest.

    All arrays are (m,): height, mean force, number of samples in the mean, and descent (0, 1, ...) that it belongs to.
    Each descent has its own offset, so that a slow drift of the sensor is not taken for force. `sample_sd_n` is the
    standard deviation of one sample. `spring` is what earlier touches found; it counts as one more
    observation. The join is solved exactly between neighbouring heights (D. J. Hudson, Fitting
    segmented curves whose join points have to be estimated, J. Am. Stat. Assoc. 61, 1966).
    Raises `StepError` where the force does not rise over at least two heights, or one if the stiffness is known.
    """
    heights = np.unique(z_mm)
    needed = 3 if spring is None else 2
    if len(heights) < needed or sample_sd_n <= 0.0:
        raise StepError(f"rests at {len(heights)} heights give no contact, {needed} are needed")
    weights = samples.astype(np.float64)
    runs = np.zeros(len(z_mm), np.int64) if run is None else run
    descents = np.unique(runs)[:, None] == runs[None, :]

    def free_of_offsets(rows: Floats) -> Floats:
        """(..., m) less each descent's weighted mean: what is left once the offsets have been fitted."""
        of = descents * weights
        means = rows @ of.T / of.sum(axis=1)
        return np.asarray(rows - means @ descents, np.float64)

    # An observation of the stiffness alone, in units of one sample.
    known = 0.0 if spring is None else (sample_sd_n / spring.sigma_n_mm) ** 2
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
        raise StepError("no contact: the force does not rise over two of these heights")
    squares = np.where(rises, -(pull**2) / np.where(rises, stretch, 1.0), np.inf)
    best = int(np.argmin(squares))
    contact, stiffness = float(joins[best]), float(pull[best] / stretch[best])
    moved = free_of_offsets(
        np.stack((stiffness * (z_mm < contact), np.maximum(0.0, contact - z_mm))).astype(np.float64)
    )
    variance = np.linalg.pinv((moved * weights) @ moved.T + np.diag((0.0, known)), hermitian=True) * sample_sd_n**2
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
ROUGH_RUN = 0
SPRING_SHARE = 0.1
"""Largest standard error of the stiffness, as a share of it, with which a touch ends."""
BESIDE_MM = 0.1
"""How far the last descent may have lain beside the contact: its rests must lie above and below it."""


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

    spring: Spring | None
    readings: list[tuple[Reading, int]] = field(default_factory=list[tuple[Reading, int]])

    @property
    def samples(self) -> int:
        return sum(reading.samples for reading, _ in self.readings)

    def contact(self) -> Contact:
        """Fit the hinge to the readings of the linear part; iterated, because that part depends on the hinge.

        More readings are kept where too few are left to give it: the descent lay too low, or they are noisy still.
        """
        contact = self._fit(-math.inf)
        for _ in range(3):
            lowest_z_mm = contact.z_mm - LINEAR_MM
            if not any(lowest_z_mm <= reading.z_mm < contact.z_mm for reading, _ in self.readings):
                break
            try:
                contact = self._fit(lowest_z_mm)
            except StepError:
                break
        return contact

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
            self.spring,
        )


async def touch_by_force(
    probe: Probe,
    reach: Reach,
    config: ForceTouchConfig,
    spring: Spring | None = None,
    near_z_mm: float | None = None,
    report: Callable[[str], None] = lambda _doing: None,
) -> Contact:
    """Touch once; the probe is left down.

    `spring` is the stiffness that the last touch found. With it and `near_z_mm`, the height of the last touch at this
    point, only the slow descents are left to do. `report` gets a few words on each part. Raises `StepError` if nothing
    is felt over the whole travel, if something is felt at its start, or if the noise leaves the contact unknown.
    """
    log, lowest_z_mm = _Log(None if spring is None else spring.next()), reach.lowest_z_mm
    highest_z_mm = reach.start_z_mm
    if near_z_mm is None or spring is None:
        report(f"down to the paper in steps of {FAST_STEP_MM:g} mm")
        felt_z_mm = await _fast(probe, reach.start_z_mm, lowest_z_mm, config)
        start_z_mm = felt_z_mm + LATE_STEPS * FAST_STEP_MM + CLEAR_STEPS * MEDIUM_STEP_MM
        report(f"steps of {MEDIUM_STEP_MM:g} mm around {felt_z_mm:.1f} mm")
        await _medium(probe, log, start_z_mm, lowest_z_mm, config)
        highest_z_mm = start_z_mm + FAST_STEP_MM
        near_z_mm = log.contact().z_mm
    run, left = ROUGH_RUN, ""
    while True:
        run += 1
        report(f"slow descent {run}{left}")
        for depth_mm, share in zip(SLOW_MM, SLOW_SHARES, strict=True):
            z_mm = max(near_z_mm - depth_mm, lowest_z_mm)
            log.readings.append((await probe.rest(z_mm, max(4, round(share * config.slow_samples))), run))
        contact = log.contact()
        if _known(contact, near_z_mm, config):
            if contact.z_mm > highest_z_mm:
                raise StepError(
                    f"the contact was found at {contact.z_mm:.2f} mm, above {highest_z_mm:.2f} mm where the brush was "
                    "in the air: the sensor is too noisy for so few samples"
                )
            return contact
        if log.samples > MOST_SAMPLES:
            raise StepError(
                f"the contact is known to only {contact.sigma_mm:.3f} mm after {log.samples} samples of the force, "
                f"{config.sigma_mm:g} mm are asked for: the sensor is too noisy for this brush"
            )
        near_z_mm = contact.z_mm
        more = max(1, math.ceil(log.samples * ((contact.sigma_mm / config.sigma_mm) ** 2 - 1.0) / config.slow_samples))
        left = f", about {more} to go: known to {contact.sigma_mm:.3f} mm, {config.sigma_mm:g} mm asked for"


def _known(contact: Contact, tried_z_mm: float, config: ForceTouchConfig) -> bool:
    """Whether the contact is known well enough, after a descent around `tried_z_mm`.

    Its standard error is computed from the stiffness. If the stiffness is uncertain, or if the descent lay beside the
    contact, the true error can be much larger.
    """
    sure = contact.spring.sigma_n_mm <= SPRING_SHARE * contact.spring.n_mm
    return sure and abs(contact.z_mm - tried_z_mm) <= BESIDE_MM and contact.sigma_mm <= config.sigma_mm


async def _fast(probe: Probe, start_z_mm: float, lowest_z_mm: float, config: ForceTouchConfig) -> float:
    """Go down in large steps; return the height of the first rest at which something is felt."""
    z_mm, reading = start_z_mm, await probe.rest(start_z_mm, config.fast_samples)
    felt_n = _felt_n(reading)
    if abs(reading.force_n) > felt_n:
        raise StepError(
            f"the force is {1e3 * reading.force_n:.1f} mN at the start of the approach, at {start_z_mm:.2f} mm: "
            "the brush touches already, or the sensor was not set to zero"
        )
    while z_mm > lowest_z_mm + 1e-6:
        z_mm = max(z_mm - FAST_STEP_MM, lowest_z_mm)
        if (await probe.rest(z_mm, config.fast_samples)).force_n > felt_n:
            return z_mm
    raise StepError(f"nothing was touched down to {lowest_z_mm:.2f} mm: the force stayed below {1e3 * felt_n:.1f} mN")


async def _medium(probe: Probe, log: _Log, start_z_mm: float, lowest_z_mm: float, config: ForceTouchConfig) -> None:
    """Go down in smaller steps until something is felt at two rests in a row."""
    z_mm, before_n = start_z_mm, 0.0
    while True:
        reading = await probe.rest(z_mm, config.medium_samples)
        log.readings.append((reading, ROUGH_RUN))
        if min(before_n, reading.force_n) > _felt_n(reading) and len(log.readings) > CLEAR_STEPS:
            return
        if z_mm <= lowest_z_mm + 1e-6:
            raise StepError(f"nothing was touched down to {z_mm:.2f} mm, in steps of {MEDIUM_STEP_MM:g} mm")
        z_mm, before_n = max(z_mm - MEDIUM_STEP_MM, lowest_z_mm), reading.force_n


def _felt_n(reading: Reading) -> float:
    return max(THRESHOLD_N, FELT_SIGMAS * reading.sd_n / math.sqrt(reading.samples))


SILENT_S = 5.0
"""A sensor that sends nothing for this long has stopped. The arm rests meanwhile, so a busy computer is given time;
while the arm moves, `force.stale_ms` is the limit."""


class ForceTap:
    """Collects force samples while an average is asked for. Hand every sample to `take`, in the event loop."""

    def __init__(self) -> None:
        self._after_ns = 0
        self._wanted: list[ForceSample] | None = None
        self._came = asyncio.Event()

    def take(self, sample: ForceSample) -> None:
        """Accept one sample of the sensor."""
        if self._wanted is not None and sample.stamp.host_ns > self._after_ns:
            self._wanted.append(sample)
        self._came.set()

    async def average(
        self, samples: int, push_axis: tuple[float, float, float], after_ns: int
    ) -> tuple[float, float, int]:
        """(mean push in N, standard deviation of one sample, samples) of the next ones received after `after_ns`.

        Raises `StepError` if the sensor falls silent.
        """
        length = math.hypot(*push_axis)
        self._after_ns, self._wanted = after_ns, []
        wanted = self._wanted
        try:
            while len(wanted) < samples:
                self._came.clear()
                async with asyncio.timeout(SILENT_S):
                    await self._came.wait()
        except TimeoutError:
            raise StepError(f"the force sensor fell silent after {len(wanted)} of {samples} samples") from None
        finally:
            self._wanted = None
        pushes = [sum(f * a for f, a in zip(s.force_n, push_axis, strict=True)) / length for s in wanted]
        return statistics.fmean(pushes), statistics.stdev(pushes), len(pushes)


class RigProbe:
    """`Probe` over one point of the sheet, on a rig's arm and force sensor."""

    def __init__(self, procedures: Procedures, tap: ForceTap, at_mm: tuple[float, float], config: TouchConfig) -> None:
        self._procedures = procedures
        self._tap = tap
        self._at_mm = at_mm
        self._config = config
        self._last_z_mm: float | None = None

    async def rest(self, z_mm: float, samples: int) -> Reading:
        """Go to the height from above, come to rest, and average this many samples."""
        force, speed_mm_s = self._config.force, self._config.speed_mm_s
        if self._last_z_mm is not None and z_mm > self._last_z_mm:
            await self._procedures.lower(*self._at_mm, z_mm + CLEAR_MM, speed_mm_s)
        rests_z_mm = await self._procedures.lower(*self._at_mm, z_mm, speed_mm_s)
        self._last_z_mm = z_mm
        after_ns = self._procedures.rig.clock.now_ns() + round(force.settle_s * 1e9)
        force_n, sd_n, count = await self._tap.average(samples, force.push_axis, after_ns)
        return Reading(rests_z_mm, force_n, count, sd_n)
