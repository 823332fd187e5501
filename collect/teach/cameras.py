"""The camera before there is a `rig.toml`: which ones there are, single pictures, frame rate, settings to lock."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from collect.rig.config_devices import LockedConfig
from collect.rig.optics import gray
from collect.teach.store import Notebook
from drivers.camera import CameraOptions, Locked, OpenCvCamera, found_settings
from drivers.clock import Clock
from drivers.samples import Stamp

Gray = NDArray[np.uint8]
LATE_MS = 2500.0
"""Until the delay is measured, a picture counts as taken this long before it came: no useful camera is slower."""
RATE_S = 2.0
"""How long frames are counted."""
LOCKED = "camera.locked."


def devices(folder: Path = Path("/dev")) -> list[str]:
    """Numbers of the video devices of this machine, as sources."""
    names = (path.name.removeprefix("video") for path in folder.glob("video*"))
    return sorted((name for name in names if name.isdecimal()), key=int)


@contextlib.asynccontextmanager
async def opened(
    source: str, clock: Clock, locked: Locked | None = None, timeout_s: float = 10.0
) -> AsyncGenerator[OpenCvCamera]:
    """A connected camera, closed at the end. Raises `DeviceError`; a setting that does not hold is one."""
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
    locked = LockedConfig.model_validate(named)
    async with opened(str(notebook.get("camera.source")), clock, Locked(**locked.model_dump())) as camera:
        yield camera


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
