"""The arm as zero touch moves it: upright over points of the sheet, and up again whatever happened."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator

from collect.errors import ForceTooHigh
from collect.rig import Rig
from collect.sheet import to_base
from drivers.geometry import brush_pose
from drivers.samples import Pose, QueuedLine


class TouchArm:
    """A vertical brush over points of the paper frame; every move goes through the limits of the driver."""

    def __init__(self, rig: Rig, slow_mm_s: float) -> None:
        self._rig = rig
        self._slow_mm_s = slow_mm_s

    async def over(self, x_mm: float, y_mm: float) -> None:
        """To travel height over a point."""
        motion = self._rig.config.motion
        await self._move(self._pose(x_mm, y_mm, motion.safe_z_mm), motion.travel_speed_mm_s)

    async def near(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """From travel height down to where the slow approach begins."""
        await self._move(self._pose(x_mm, y_mm, z_mm), self._rig.config.motion.press_speed_mm_s)

    async def to(self, x_mm: float, y_mm: float, z_mm: float) -> float:
        """Slowly to a height; returns the one at which the arm rests."""
        await self._move(self._pose(x_mm, y_mm, z_mm), self._slow_mm_s)
        return (await self._rig.robot.where()).z_mm

    async def press(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Slowly down to a height and up to travel height; the arm lifts by itself even if this program dies."""
        motion = self._rig.config.motion
        lines = [
            QueuedLine(self._pose(x_mm, y_mm, z_mm), self._slow_mm_s),
            QueuedLine(self._pose(x_mm, y_mm, motion.safe_z_mm), motion.press_speed_mm_s),
        ]
        await self._rig.robot.sequence(lines, acc_mm_s2=motion.acc_mm_s2)

    async def lift(self) -> None:
        """Straight up to travel height from wherever the tip is."""
        here = await self._rig.robot.where()
        motion = self._rig.config.motion
        if here.z_mm < motion.safe_z_mm:
            up = Pose(here.x_mm, here.y_mm, motion.safe_z_mm, *here.quaternion)
            await self._move(up, motion.press_speed_mm_s)

    @contextlib.asynccontextmanager
    async def lifted_after(self) -> AsyncGenerator[None]:
        """Lift at the end and after any error but a stop: who stopped the arm wants it to stay."""
        try:
            yield
        except (asyncio.CancelledError, ForceTooHigh):
            raise
        except Exception as error:
            try:
                await self.lift()
            except Exception as trouble:
                error.add_note(f"The brush could not be lifted: {trouble}")
            raise
        await self.lift()

    def _pose(self, x_mm: float, y_mm: float, z_mm: float) -> Pose:
        base_x, base_y = to_base(self._rig.config.paper, x_mm, y_mm)
        return brush_pose(base_x, base_y, z_mm, heading_deg=self._rig.config.paper.yaw_deg)

    async def _move(self, target: Pose, speed_mm_s: float) -> None:
        await self._rig.robot.move(target, speed_mm_s=speed_mm_s, acc_mm_s2=self._rig.config.motion.acc_mm_s2)
