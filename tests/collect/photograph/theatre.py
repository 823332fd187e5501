"""An arm and a camera that see each other late: frames show where the arm was some time ago."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from brushloop.collect.photograph.photographer import ArmTrips, Photographer
from brushloop.collect.rig.config import CameraConfig
from brushloop.drivers.devices import Frame, Pose, PoseSample, Stamp
from brushloop.drivers.host import Clock
from tests.simulated_time import LoopClock

PERIOD_S, TRIP_S = 0.02, 0.06
PARK_MM, OVER_MM = (0.0, 0.0, 100.0), (200.0, 0.0, 100.0)
OUT_MM, IN_MM = 60.0, 120.0
"""From here to there on its way the arm comes into the picture."""


@dataclass
class Theatre:
    """`Robot` and `Camera` as far as a photographer needs them; every delay is in seconds of the loop's time."""

    delay: Callable[[float], float]
    """By the time of exposure, in s since the start."""
    clock: Clock = field(default_factory=LoopClock)
    intruder: bool = False
    """A hand in the picture."""
    ink: int = 0
    """Strokes on the sheet."""

    def __post_init__(self) -> None:
        self.start_s = self._now_s()
        self._legs: list[tuple[float, float, float]] = [(self.start_s, 0.0, 0.0)]
        self._shown = 0
        self.exposures_s: dict[int, float] = {}
        """By the sequence of the frame, since the start: the truth."""

    def photographer(self, **limits: float) -> Photographer:
        config = CameraConfig.model_validate({"kind": "opencv", "source": "0", **limits})
        trips = ArmTrips(OVER_MM, PARK_MM, lambda: self.go(1.0), lambda: self.go(0.0), self._is_over)
        return Photographer(self, self, config, self.clock, trips)  # pyright: ignore[reportArgumentType]

    def way(self, t_s: float) -> float:
        """Where the arm was: 0 parked, 1 over the sheet."""
        began_s, start, end = next(leg for leg in reversed(self._legs) if leg[0] <= t_s or leg is self._legs[0])
        return start + (end - start) * min(max((t_s - began_s) / TRIP_S, 0.0), 1.0)

    def latest(self) -> PoseSample:
        now_ns = self.clock.now_ns()
        x_mm = OVER_MM[0] * self.way(now_ns / 1e9)
        return PoseSample(Stamp(now_ns), Pose(x_mm, 0.0, 100.0, 1.0, 0.0, 0.0, 0.0))

    async def fresh(self, after: Stamp) -> Frame:
        while True:
            exposed_s = self.start_s + self._shown * PERIOD_S
            arrival_s = exposed_s + self.delay(exposed_s - self.start_s)
            if arrival_s > self._now_s():
                await asyncio.sleep(arrival_s - self._now_s())
                continue
            self._shown += 1
            if arrival_s * 1e9 >= after.host_ns:
                self.exposures_s[self._shown] = exposed_s - self.start_s
                stamp = Stamp(round(arrival_s * 1e9), None, self._shown)
                return Frame(stamp, stamp.host_ns, self._draw(exposed_s))

    async def go(self, way: float) -> None:
        now_s = self._now_s()
        self._legs.append((now_s, self.way(now_s), way))
        await asyncio.sleep(TRIP_S + 0.01)

    async def _is_over(self) -> bool:
        return self.way(self._now_s()) > 0.5

    def _draw(self, t_s: float) -> np.ndarray:
        image = np.full((120, 160), 230, np.uint8)
        x_mm = OVER_MM[0] * self.way(t_s)
        if x_mm > OUT_MM:
            shown = min((x_mm - OUT_MM) / (IN_MM - OUT_MM), 1.0)
            cv2.circle(image, (80, round(120 + 30 - 90 * shown)), 30, (70,), -1)
        if self.intruder:
            cv2.rectangle(image, (10, 10), (50, 50), (40,), -1)
        for number in range(self.ink):
            image[5 + 12 * (number // 8) :][:2, 5 + 18 * (number % 8) :][:, :6] = 15
        return image

    def _now_s(self) -> float:
        return self.clock.now_ns() / 1e9
