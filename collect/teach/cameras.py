"""The camera before there is a `rig.toml`: which ones there are, single pictures, frame rate, settings to lock."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.collect.rig.optics import gray
from brushloop.collect.teach.store import Notebook
from brushloop.drivers.camera import CameraOptions, Locked, OpenCvCamera, found_settings
from brushloop.drivers.devices import Stamp
from brushloop.drivers.host import Clock

Gray = NDArray[np.uint8]
LATE_MS = 2500.0
"""Until the delay is measured, a picture counts as taken this long before it came: no useful camera is slower."""
RATE_S = 2.0
"""How long frames are counted."""
LOCKED = "camera.locked."
TILE_PX, NUMBER_PX = (480, 360), 64
"""Width and height of one picture beside others, and the side of the square with its number."""


def devices(folder: Path = Path("/dev")) -> list[str]:
    """Numbers of the video devices of this machine, as sources."""
    names = (path.name.removeprefix("video") for path in folder.glob("video*"))
    return sorted((name for name in names if name.isdecimal()), key=int)


@contextlib.asynccontextmanager
async def opened(
    source: str, clock: Clock, locked: Locked | None = None, timeout_s: float = 10.0
) -> AsyncGenerator[OpenCvCamera]:
    """A connected camera, closed at the end. Raises `DeviceError`, also for a setting that the camera does not keep."""
    camera = OpenCvCamera(CameraOptions(source, LATE_MS, timeout_s, locked=locked or Locked()), clock)
    await camera.connect()
    try:
        yield camera
    finally:
        await camera.close()


async def still(camera: OpenCvCamera, clock: Clock) -> Gray:
    """A gray picture that was taken after now, however late the camera is."""
    return gray((await camera.fresh(Stamp(clock.now_ns()))).image)


@contextlib.asynccontextmanager
async def taught_camera(notebook: Notebook, clock: Clock) -> AsyncGenerator[OpenCvCamera]:
    """The camera that was taught, with its settings locked."""
    named = {field.removeprefix(LOCKED): t.value for field, t in notebook.values.items() if field.startswith(LOCKED)}
    async with opened(str(notebook.get("camera.source")), clock, Locked.model_validate(named)) as camera:
        yield camera


def side_by_side(pictures: Sequence[Gray]) -> Gray:
    """Pictures of any sizes in one, two in a row, numbered from 1 in their upper left corners."""
    tiles = list[Gray]()
    for number, picture in enumerate(pictures, 1):
        height, width = picture.shape
        scale = min(TILE_PX[0] / width, TILE_PX[1] / height)
        small = cv2.resize(picture, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
        tile = np.zeros(TILE_PX[::-1], np.uint8)
        tile[: small.shape[0], : small.shape[1]] = small
        tile[:NUMBER_PX, :NUMBER_PX] = 0
        cv2.putText(tile, str(number), (10, NUMBER_PX - 12), cv2.FONT_HERSHEY_SIMPLEX, 1.8, (255,), 5, cv2.LINE_AA)
        tiles.append(tile)
    if len(tiles) % 2 and len(tiles) > 1:
        tiles.append(np.zeros(TILE_PX[::-1], np.uint8))
    rows = [np.hstack(tiles[first : first + 2]) for first in range(0, len(tiles), 2)]
    return np.vstack(rows)


async def frame_rate_hz(camera: OpenCvCamera) -> float:
    """Frames per second, counted."""
    after, count, began_s = Stamp(0), 0, time.monotonic()
    while time.monotonic() - began_s < RATE_S:
        frame = await camera.fresh(after)
        after = Stamp(frame.exposed_after_ns + 1)
        count += 1
    return (count - 1) / (time.monotonic() - began_s)


async def locked_settings(source: str) -> dict[str, float]:
    """What a device chose by itself; nothing for a stream, whose settings only its own set-up can change."""
    return await asyncio.to_thread(found_settings, int(source), RATE_S) if source.isdecimal() else {}
