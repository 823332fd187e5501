"""Averages of the force at rest, from the stream that is recorded anyway; and the probe that moves between them."""

from __future__ import annotations

import asyncio
import math
import statistics

from collect.errors import StepError
from collect.rig.config_touch import ForceTouchConfig
from collect.touch.arm import TouchArm
from collect.touch.force import Reading
from drivers.clock import Clock
from drivers.force.samples import ForceSample

SILENT_S = 1.0
"""A sensor that sends nothing for so long has stopped."""


class ForceTap:
    """Collects samples while an average is wanted. Hand `take` every sample, in the event loop."""

    def __init__(self) -> None:
        self._after_ns = 0
        self._wanted: list[ForceSample] | None = None
        self._came = asyncio.Event()

    def take(self, sample: ForceSample) -> None:
        """One sample of the sensor."""
        if self._wanted is not None and sample.stamp.host_ns > self._after_ns:
            self._wanted.append(sample)
        self._came.set()

    async def average(
        self, samples: int, push_axis: tuple[float, float, float], after_ns: int
    ) -> tuple[float, float, int]:
        """(mean push in N, standard deviation of one sample, samples) of the next ones received after `after_ns`.

        Raises `StepError` where the sensor falls silent.
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

    def __init__(
        self, arm: TouchArm, tap: ForceTap, clock: Clock, at_mm: tuple[float, float], config: ForceTouchConfig
    ) -> None:
        self._arm = arm
        self._tap = tap
        self._clock = clock
        self._at_mm = at_mm
        self._config = config
        self._last_z_mm: float | None = None

    async def rest(self, z_mm: float, samples: int) -> Reading:
        """Go to the height, from above, come to rest, average so many samples."""
        if self._last_z_mm is not None and z_mm > self._last_z_mm and self._config.clear_mm > 0.0:
            await self._arm.to(*self._at_mm, z_mm + self._config.clear_mm)
        rests_z_mm = await self._arm.to(*self._at_mm, z_mm)
        self._last_z_mm = z_mm
        after_ns = self._clock.now_ns() + round(self._config.settle_s * 1e9)
        force_n, sd_n, count = await self._tap.average(samples, self._config.push_axis, after_ns)
        return Reading(rests_z_mm, force_n, count, sd_n)
