"""Latest values for a screen: written at the devices' rates, looked at ten times a second."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.protocols import Robot
from drivers.samples import ForceSample, Identity, Pose, PoseSample, QueuedLine

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

SLOT_NS = 100_000_000
"""One value of the trace: the largest force of a tenth of a second, so that a short peak is seen."""
TRACE_SLOTS = 300


@dataclass(frozen=True, slots=True)
class Picture:
    """A small picture of the camera's newest frame."""

    number: int
    image: NDArray[np.uint8]
    """(h, w) gray."""
    blur_px: float | None = None
    """Standard deviation of the blur at its steepest edges, in pixels of the full frame; None without an edge."""


class Telemetry:
    """Slots that are overwritten; each write is short and none waits for a reader."""

    def __init__(self) -> None:
        self.target_mm: tuple[float, float, float] | None = None
        """Where the arm was last sent."""
        self.tip_mm: tuple[float, float, float] | None = None
        """Where it was last seen, however long ago."""
        self.picture: Picture | None = None
        self._lock = threading.Lock()
        self._peaks: deque[float] = deque(maxlen=TRACE_SLOTS)
        self._slot = -1

    def force(self, sample: ForceSample) -> None:
        """A sample of the force sensor, at its full rate."""
        self.note_force(math.hypot(*sample.force_n), sample.stamp.host_ns)

    def note_force(self, force_n: float, t_ns: int) -> None:
        """A force in N at a time of the host."""
        slot = t_ns // SLOT_NS
        with self._lock:
            if slot != self._slot:
                self._slot = slot
                self._peaks.append(force_n)
            elif self._peaks and force_n > self._peaks[-1]:
                self._peaks[-1] = force_n

    def trace_n(self) -> tuple[float, ...]:
        """Peaks by tenth of a second, oldest first."""
        with self._lock:
            return tuple(self._peaks)


class NotedRobot:
    """A robot that notes where it is sent; all else is passed on."""

    def __init__(self, robot: Robot, telemetry: Telemetry) -> None:
        self._robot = robot
        self._telemetry = telemetry

    async def connect(self) -> Identity:
        """See `Robot`."""
        return await self._robot.connect()

    async def enable(self) -> None:
        """See `Robot`."""
        await self._robot.enable()

    async def move(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """See `Robot`."""
        self._telemetry.target_mm = target.position_mm
        await self._robot.move(target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)

    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float, blend_mm: float) -> None:
        """See `Robot`."""
        self._telemetry.target_mm = poses[-1].position_mm if poses else None
        await self._robot.follow(poses, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2, blend_mm=blend_mm)

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        """See `Robot`."""
        self._telemetry.target_mm = min((line.target.position_mm for line in lines), key=lambda at: at[2], default=None)
        return await self._robot.sequence(lines, acc_mm_s2=acc_mm_s2)

    async def stop(self) -> None:
        """See `Robot`."""
        await self._robot.stop()

    def latest(self) -> PoseSample:
        """See `Robot`."""
        return self._robot.latest()

    async def where(self) -> Pose:
        """See `Robot`."""
        return await self._robot.where()

    async def confirm(self) -> None:
        """See `Robot`."""
        await self._robot.confirm()

    async def take_up(self) -> Pose:
        """See `Robot`."""
        return await self._robot.take_up()

    def listen(self, on_sample: Callable[[PoseSample], None] | None) -> None:
        """See `Robot`."""
        self._robot.listen(on_sample)

    def check(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """See `Robot`."""
        self._robot.check(target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)

    async def close(self) -> None:
        """See `Robot`."""
        await self._robot.close()
