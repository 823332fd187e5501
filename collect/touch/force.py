"""One touch by force: fast down to a threshold, slowly around it, and a hinge through the means at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from collect.errors import StepError
from collect.rig.config_touch import ForceTouchConfig
from collect.touch.contact import Contact, find_contact
from collect.touch.reach import Reach

SLOW_MM = (-0.15, 0.08, 0.4)
"""Depths of the three rests of a slow descent. Two fix the hinge's arms, the middle one the join: a row of equal
steps needs more than twice the samples for the same error."""
SLOW_SHARES = (0.38, 0.42, 0.2)
FELT_SIGMAS = 4.0
"""A mean force that far out of its noise is a push."""
LATE_STEPS = 2
"""A soft brush is felt by the fast approach up to so many steps too late."""
CLEAR_STEPS = 4
"""The medium approach begins with so many rests in the air."""
ROUGH_RUN = 0


@dataclass(frozen=True, slots=True)
class Reading:
    """The arm at rest at a height, and the mean push there."""

    z_mm: float
    """The controller's height, not the commanded one."""
    force_n: float
    samples: int
    sd_n: float
    """Of one sample."""


class Probe(Protocol):
    """A vertical brush over one point of the sheet."""

    async def rest(self, z_mm: float, samples: int) -> Reading:
        """Go to the height, come to rest, average so many samples."""
        ...


@dataclass(slots=True)
class _Log:
    """The readings of one touch so far."""

    readings: list[tuple[Reading, int]] = field(default_factory=list[tuple[Reading, int]])

    @property
    def samples(self) -> int:
        return sum(reading.samples for reading, _ in self.readings)

    def contact(self, config: ForceTouchConfig) -> Contact:
        """The hinge through what lies no deeper than the straight part; which part that is, depends on the hinge."""
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
    """One touch; the probe is left down.

    `near_z_mm` is where it touched last time, and spares the fast approach. Raises `StepError` where nothing is felt
    over the whole travel, where something is felt at its start, and where the noise leaves the contact unknown.
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
    """The height of the first rest at which something is felt."""
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
    """Down in smaller steps until two rests in a row feel it."""
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
