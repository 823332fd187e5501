"""A small picture of what the camera sees, a few times a second, for a screen. Never slows the run."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator

import cv2
import numpy as np

from calibrate.stroke.preprocess import Gray
from collect.engine.telemetry import Picture, Telemetry
from collect.photograph.new_ink import gray
from collect.quality.picture import blur_px
from drivers.errors import DeviceError
from drivers.protocols import Camera
from drivers.samples import Frame, Stamp

PERIOD_S = 0.2
WIDTH_PX = 320
TILES = 4
"""The frame is divided into so many by so many: the blur is told where there is most to see, at the board."""


@contextlib.asynccontextmanager
async def previewing(telemetry: Telemetry, camera: Camera, *, wanted: bool) -> AsyncGenerator[None]:
    """Within the block keep `telemetry.picture` fresh, where anybody wants it."""
    if not wanted:
        yield
        return
    watch = asyncio.create_task(_watch(telemetry, camera), name="preview")
    try:
        yield
    finally:
        watch.cancel()
        await asyncio.gather(watch, return_exceptions=True)


async def _watch(telemetry: Telemetry, camera: Camera) -> None:
    number = 0
    while True:
        with contextlib.suppress(DeviceError):  # the run hears of it by its own question
            frame = await camera.fresh(Stamp(0))
            telemetry.picture = await asyncio.to_thread(picture_of, frame, number)
            number += 1
        await asyncio.sleep(PERIOD_S)


def picture_of(frame: Frame, number: int) -> Picture:
    """A frame made small, and how blurred it is."""
    image = gray(frame.image)
    height, width = image.shape
    size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Picture(number, small, blur_px(_busiest(image, small)))


def _busiest(image: Gray, small: Gray) -> Gray:
    """The tile of the full frame that holds most contrast."""
    tiles = [(row, column) for row in range(TILES) for column in range(TILES)]
    row, column = max(tiles, key=lambda at: float(_tile(small, *at).std()))
    return np.ascontiguousarray(_tile(image, row, column))


def _tile(image: Gray, row: int, column: int) -> Gray:
    height, width = image.shape
    return image[
        row * height // TILES : (row + 1) * height // TILES, column * width // TILES : (column + 1) * width // TILES
    ]
