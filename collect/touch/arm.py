"""The rig as zero touch uses it: the upright brush over points of the sheet, and the mean force where it rests."""

from __future__ import annotations

import asyncio
import contextlib
import math
import statistics
from collections.abc import AsyncGenerator, Sequence
from typing import Protocol

from brushloop.collect.errors import StepError, arm_at_fault
from brushloop.collect.motion import moves
from brushloop.collect.motion.moves import Move
from brushloop.collect.rig.config_touch import ForceTouchConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.touch.force import Reading
from brushloop.drivers.devices import ForceSample, Frame, QueuedLine
from brushloop.drivers.host import Clock


class Effector(Protocol):
    """Actions on the rig that touches need, apart from moving the brush; each begins and ends at travel height."""

    async def dip(self) -> None:
        """Fill the brush."""
        ...

    async def capture(self) -> Frame:
        """Park, and photograph."""
        ...


class TouchEffector(Effector, Protocol):
    """Actions on the rig that zero touch needs."""

    async def zero_touch(self) -> float:
        """Visit the taught height; returns where the arm rests."""
        ...


class TouchArm:
    """A vertical brush over points of the paper frame; makes the moves of `motion.moves`."""

    def __init__(self, rig: Rig, slow_mm_s: float) -> None:
        self._rig = rig
        self._slow_mm_s = slow_mm_s

    async def over(self, x_mm: float, y_mm: float) -> None:
        """Go to travel height over a point."""
        await self.go(moves.over(self._rig.config, x_mm, y_mm))

    async def near(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Go from travel height down to where the slow approach begins."""
        await self.go(moves.near(self._rig.config, x_mm, y_mm, z_mm))

    async def to(self, x_mm: float, y_mm: float, z_mm: float) -> float:
        """Go slowly to a height; returns the height at which the arm rests."""
        await self.go(Move(moves.touching(self._rig.config, x_mm, y_mm, z_mm), self._slow_mm_s))
        return (await self._rig.robot.where()).z_mm

    async def press(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Go slowly down to a height and up to travel height; the arm lifts even if this program dies."""
        config = self._rig.config
        down = Move(moves.touching(config, x_mm, y_mm, z_mm), self._slow_mm_s)
        await self.sequence([down, moves.up(config, x_mm, y_mm)])

    async def sequence(self, pressing: Sequence[Move]) -> None:
        """Send several moves to the controller before the first begins."""
        lines = [QueuedLine(move.target, move.speed_mm_s) for move in pressing]
        await self._rig.robot.sequence(lines, acc_mm_s2=self._rig.config.motion.acc_mm_s2)

    async def lift(self) -> None:
        """Go straight up to travel height from wherever the tip is."""
        for move in moves.lift(self._rig.config, await self._rig.robot.where()):
            await self.go(move)

    async def go(self, move: Move) -> None:
        """Make one move and wait until it ends."""
        acc_mm_s2 = self._rig.config.motion.acc_mm_s2
        await self._rig.robot.move(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=acc_mm_s2)

    @contextlib.asynccontextmanager
    async def lifted_after(self) -> AsyncGenerator[None]:
        """Lift at the end and after an error, unless the arm is at fault. After a stop the arm stays where it is."""
        try:
            yield
        except Exception as error:
            if arm_at_fault(error):
                raise
            try:
                await self.lift()
            except Exception as trouble:
                error.add_note(f"The brush could not be lifted: {trouble}")
            raise
        await self.lift()


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
        """Go to the height from above, come to rest, and average this many samples."""
        if self._last_z_mm is not None and z_mm > self._last_z_mm and self._config.clear_mm > 0.0:
            await self._arm.to(*self._at_mm, z_mm + self._config.clear_mm)
        rests_z_mm = await self._arm.to(*self._at_mm, z_mm)
        self._last_z_mm = z_mm
        after_ns = self._clock.now_ns() + round(self._config.settle_s * 1e9)
        force_n, sd_n, count = await self._tap.average(samples, self._config.push_axis, after_ns)
        return Reading(rests_z_mm, force_n, count, sd_n)
