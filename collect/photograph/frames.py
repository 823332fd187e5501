"""Photographs without distortion; the camera's frames, each compared with the view without the arm."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.preprocess import Gray
from brushloop.collect.errors import StepError
from brushloop.collect.rig.config import CameraConfig
from brushloop.drivers.devices import Camera, Frame, Stamp
from brushloop.drivers.errors import DeviceError
from brushloop.drivers.host import alongside, finished

Thumbnail = NDArray[np.float32]
WIDTH_PX = 160
"""Width of a thumbnail. A pixel averages about 2 mm of a sheet: noise is gone, and an arm is tens of pixels wide."""
CHANGED_LEVELS = 25.0
"""Difference in gray levels, corrected for the light, from which on a pixel counts as changed."""


def undistorted(camera: CameraConfig, photograph: Gray) -> Gray:
    """An (h, w) photograph without the lens distortion that recordings keep.

    Raises `StepError` if photographs no longer have the size at which the lens was calibrated.
    """
    try:
        return photograph if camera.optics is None else camera.optics.undistort(photograph)
    except CaptureRefused as error:
        remedy = "set camera.locked, or calibrate the lens at this size"
        raise StepError(f"the camera's picture {error.what}: {remedy}") from None


def thumbnail(image: Gray) -> Thumbnail:
    """(h, 160) gray levels of an (h, w) frame."""
    height, width = image.shape
    size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def changed_share(now: Thumbnail, before: Thumbnail) -> float:
    """Share of the pixels that differ, 0 to 1, corrected for the overall light; 1 for frames of different sizes."""
    if now.shape != before.shape:
        return 1.0
    light = float(np.median((now + 1.0) / (before + 1.0)))
    return float(np.mean(np.abs(now - light * before) > CHANGED_LEVELS))


FRAME_PERIOD_S = 0.2
"""Time between two pictures for a person who watches."""


def each_frame(camera: Camera, shows: Sequence[Callable[[Frame], None]]) -> AbstractAsyncContextManager[None]:
    """Within the block pass the newest frame to each of `shows`, in a thread, every `FRAME_PERIOD_S`.

    Never slows a run; nothing is shown after the block. Without `shows`, the camera is not asked for frames.
    """

    async def watch() -> None:
        while shows:
            with contextlib.suppress(DeviceError):  # whoever takes a photograph finds out
                frame = await camera.fresh(Stamp(0))
                for show in shows:
                    await finished(asyncio.to_thread(show, frame))
            await asyncio.sleep(FRAME_PERIOD_S)

    return alongside(watch(), "camera picture")


Series = list[tuple[float, float]]
"""A quantity at several times, in s: of frames, when they arrived, and the share of the picture that has changed."""
ARM_SHARE = 0.02
"""An arm over the sheet hides a far larger share of the picture than a stroke, or a drawn figure, covers with ink."""
STILL_SHARE = 0.005
"""Two frames that differ by less show no motion; even a clock that a camera draws into its picture changes less."""


@dataclass(frozen=True, slots=True)
class View:
    """One frame, and how far it differs from others."""

    frame: Frame
    small: Thumbnail
    changed: float
    """Share of the picture that differs from the reference; 0 while there is none yet."""
    moved: float
    """Share that differs from the frame before; 1 for the first."""

    @property
    def arm(self) -> bool:
        """Whether something is in the picture that the reference does not show."""
        return self.changed >= ARM_SHARE

    @property
    def still(self) -> bool:
        """Whether nothing moved since the frame before."""
        return self.moved < STILL_SHARE


class Frames:
    """The camera's frames from now on."""

    def __init__(self, reference: Thumbnail | None) -> None:
        self._reference = reference
        self._before: Thumbnail | None = None
        self._next: asyncio.Future[View] = asyncio.get_running_loop().create_future()
        """The view that comes next, or why none does."""
        self.seen: Series = []
        """Of every frame so far: arrival, and how far it differs from the reference, 0 to 1."""

    async def first(self, wanted: Callable[[View], bool], *, within_s: float) -> View | None:
        """The first frame from now on that is wanted; None if none is within `within_s`.

        Raises `DeviceError` if no frame comes.
        """
        loop = asyncio.get_running_loop()
        until_s = loop.time() + within_s
        while not wanted(view := await asyncio.shield(self._next)):
            if loop.time() > until_s:
                return None
        return view

    async def follow(self, camera: Camera) -> None:
        """Take frame after frame, until cancelled or the camera fails."""
        after = Stamp(0)
        try:
            while True:
                frame = await camera.fresh(after)
                after = Stamp(frame.exposed_after_ns + 1)
                view = await asyncio.to_thread(self._view, frame)
                self._before = view.small
                self.seen.append((frame.stamp.host_ns / 1e9, view.changed))
                self._next.set_result(view)
                self._next = asyncio.get_running_loop().create_future()
        except Exception as error:
            self._next.set_exception(error)
            self._next.exception()  # whoever looks at no frame need not know it

    def _view(self, frame: Frame) -> View:
        small = thumbnail(frame.image)
        changed = 0.0 if self._reference is None else changed_share(small, self._reference)
        moved = 1.0 if self._before is None else changed_share(small, self._before)
        return View(frame, small, changed, moved)


@contextlib.asynccontextmanager
async def watching(camera: Camera, reference: Thumbnail | None) -> AsyncGenerator[Frames]:
    """Within the block, follow the frames; `reference` is the view without the arm."""
    frames = Frames(reference)
    async with alongside(frames.follow(camera), "camera frames"):
        yield frames
