"""Newest values for a screen: force, target and camera picture, written at the devices' rates."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import threading
from collections import deque
from collections.abc import AsyncGenerator, Callable, Sequence
from typing import Any, cast

import cv2
import numpy as np

from brushloop.calibrate.stroke import Gray
from brushloop.collect.engine.snapshot import Picture
from brushloop.collect.quality.measure import blur_px
from brushloop.collect.rig.optics import gray
from brushloop.drivers.devices import Camera, ForceSample, Frame, Pose, QueuedLine, Robot, Stamp
from brushloop.drivers.errors import DeviceError

SLOT_NS = 100_000_000
"""Time that one value of the trace covers. The value is the peak force, so that a short peak is seen."""
TRACE_SLOTS = 300
FRAME_PERIOD_S = 0.2
"""Time between two pictures of the camera."""
WIDTH_PX = 320
TILES = 4
"""Rows and columns of tiles in a frame. The blur is measured in the tile with most contrast, which shows the board."""


class Telemetry:
    """Newest values. Each write is short, and none waits for a reader."""

    def __init__(self) -> None:
        self.target_mm: tuple[float, float, float] | None = None
        """Where the arm was last sent."""
        self.tip_mm: tuple[float, float, float] | None = None
        """Where the brush tip was last seen, however long ago."""
        self.picture: Picture | None = None
        self._lock = threading.Lock()
        self._peaks: deque[float] = deque(maxlen=TRACE_SLOTS)
        self._slot = -1

    def force(self, sample: ForceSample) -> None:
        """Take a sample of the force sensor; called at its full rate."""
        self.note_force(math.hypot(*sample.force_n), sample.stamp.host_ns)

    def note_force(self, force_n: float, t_ns: int) -> None:
        """Take a force in N at host time `t_ns`."""
        slot = t_ns // SLOT_NS
        with self._lock:
            if slot != self._slot:
                self._slot = slot
                self._peaks.append(force_n)
            elif self._peaks and force_n > self._peaks[-1]:
                self._peaks[-1] = force_n

    def trace_n(self) -> tuple[float, ...]:
        """Peak force of each tenth of a second, oldest first."""
        with self._lock:
            return tuple(self._peaks)


def noting_targets(robot: Robot, telemetry: Telemetry) -> Robot:
    """Return the same robot, with its targets noted in `telemetry`."""
    return cast("Robot", _NotedRobot(robot, telemetry))


class _NotedRobot:
    """Notes targets; passes every method without a target on to the robot."""

    def __init__(self, robot: Robot, telemetry: Telemetry) -> None:
        self._robot = robot
        self._telemetry = telemetry

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    async def move(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        self._telemetry.target_mm = target.position_mm
        await self._robot.move(target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)

    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float, blend_mm: float) -> None:
        self._telemetry.target_mm = poses[-1].position_mm if poses else None
        await self._robot.follow(poses, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2, blend_mm=blend_mm)

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        self._telemetry.target_mm = min((line.target.position_mm for line in lines), key=lambda at: at[2], default=None)
        return await self._robot.sequence(lines, acc_mm_s2=acc_mm_s2)


@contextlib.asynccontextmanager
async def each_frame(camera: Camera, show: Callable[[Frame], None]) -> AsyncGenerator[None]:
    """Within the block call `show`, in a thread, with the newest frame every `FRAME_PERIOD_S`. Never slows the run."""

    async def watch() -> None:
        while True:
            with contextlib.suppress(DeviceError):  # the run finds out when it takes a photograph itself
                await asyncio.to_thread(show, await camera.fresh(Stamp(0)))
            await asyncio.sleep(FRAME_PERIOD_S)

    task = asyncio.create_task(watch(), name="camera picture")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@contextlib.asynccontextmanager
async def previewing(telemetry: Telemetry, camera: Camera, *, wanted: bool) -> AsyncGenerator[None]:
    """Within the block keep `telemetry.picture` up to date, if `wanted`."""
    numbers = itertools.count()

    def show(frame: Frame) -> None:
        telemetry.picture = _picture_of(frame, next(numbers))

    async with each_frame(camera, show) if wanted else contextlib.nullcontext():
        yield


def _picture_of(frame: Frame, number: int) -> Picture:
    image = gray(frame.image)
    height, width = image.shape
    size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Picture(number, small, blur_px(_busiest_tile(image, small)))


def _busiest_tile(image: Gray, small: Gray) -> Gray:
    """The tile of the full frame with most contrast."""
    tiles = [(row, column) for row in range(TILES) for column in range(TILES)]
    row, column = max(tiles, key=lambda at: float(_tile(small, *at).std()))
    return np.ascontiguousarray(_tile(image, row, column))


def _tile(image: Gray, row: int, column: int) -> Gray:
    height, width = image.shape
    return image[
        row * height // TILES : (row + 1) * height // TILES, column * width // TILES : (column + 1) * width // TILES
    ]
