"""Where the arm is and what the camera sees while a person works: for display only, no step depends on it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Awaitable, Callable

from brushloop.collect.rig.optics import gray
from brushloop.collect.teach.arm import tip_of
from brushloop.collect.teach.camera import taught_camera
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Picture
from brushloop.drivers.devices import Pose, Stamp
from brushloop.drivers.errors import DeviceError

POSE_S = 0.3
"""Time between two poses."""
AGAIN_S = 3.0
"""Time after which a device that did not answer is asked again."""
See = Callable[[Pose | None, bool], None]
"""Called with the tip, or with the flange and False before the tip is taught; None while the arm does not answer."""


@contextlib.asynccontextmanager
async def watched(
    day: Day, see_pose: See, see_picture: Callable[[Picture | None], None], wanted: Callable[[], bool]
) -> AsyncGenerator[None]:
    """Watch until the block ends. A picture is taken only while one is `wanted`, and only from a stream.

    A device on a cable has one reader at a time, and that is the step.
    """
    tasks = [
        asyncio.create_task(_again_and_again(lambda: _poses(day, see_pose)), name="pose to look at"),
        asyncio.create_task(_again_and_again(lambda: _pictures(day, see_picture, wanted)), name="picture to look at"),
    ]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _again_and_again(look: Callable[[], Awaitable[None]]) -> None:
    while True:
        with contextlib.suppress(DeviceError):
            await look()
        await asyncio.sleep(AGAIN_S)


async def _poses(day: Day, see: See) -> None:
    if "robot.framing" not in day.notebook.values:
        return
    try:
        async with day.arm() as reader:
            while True:
                flange = await reader.flange_now()
                known = "robot.tcp_offset_mm" in day.notebook.values
                if known:
                    tip_mm = tip_of(flange, day.notebook.numbers("robot.tcp_offset_mm"))
                    see(Pose(*tip_mm, *flange.quaternion), known)
                else:
                    see(flange, known)
                await asyncio.sleep(POSE_S)
    finally:
        see(None, False)


async def _pictures(day: Day, see: Callable[[Picture | None], None], wanted: Callable[[], bool]) -> None:
    while not (wanted() and "://" in str(day.notebook.get("camera.source") or "")):
        await asyncio.sleep(POSE_S)
    try:
        async with taught_camera(day.notebook, day.clock) as camera:
            after = Stamp(0)
            while wanted():
                frame = await camera.fresh(after)
                after = Stamp(frame.exposed_after_ns + 1)
                see(gray(frame.image))
                await asyncio.sleep(POSE_S)
    finally:
        see(None)
