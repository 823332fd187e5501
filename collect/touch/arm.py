"""The arm as zero touch moves it: upright over points of the sheet, and up again whatever happened."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Sequence

from collect.errors import ForceTooHigh
from collect.motion import touches as moves
from collect.motion.procedures import Move
from collect.rig.devices import Rig
from drivers.samples import QueuedLine


class TouchArm:
    """A vertical brush over points of the paper frame; its targets are those of `touch.moves`."""

    def __init__(self, rig: Rig, slow_mm_s: float) -> None:
        self._rig = rig
        self._slow_mm_s = slow_mm_s

    async def over(self, x_mm: float, y_mm: float) -> None:
        """To travel height over a point."""
        await self.go(moves.over(self._rig.config, x_mm, y_mm))

    async def near(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """From travel height down to where the slow approach begins."""
        await self.go(moves.near(self._rig.config, x_mm, y_mm, z_mm))

    async def to(self, x_mm: float, y_mm: float, z_mm: float) -> float:
        """Slowly to a height; returns the one at which the arm rests."""
        await self.go(Move(moves.upright(self._rig.config, x_mm, y_mm, z_mm), self._slow_mm_s))
        return (await self._rig.robot.where()).z_mm

    async def press(self, x_mm: float, y_mm: float, z_mm: float) -> None:
        """Slowly down to a height and up to travel height; the arm lifts by itself even if this program dies."""
        config = self._rig.config
        down = Move(moves.upright(config, x_mm, y_mm, z_mm), self._slow_mm_s)
        await self.sequence([down, moves.up(config, x_mm, y_mm)])

    async def sequence(self, pressing: Sequence[Move]) -> None:
        """Moves that the controller has all of before the first begins."""
        lines = [QueuedLine(move.target, move.speed_mm_s) for move in pressing]
        await self._rig.robot.sequence(lines, acc_mm_s2=self._rig.config.motion.acc_mm_s2)

    async def lift(self) -> None:
        """Straight up to travel height from wherever the tip is."""
        for move in moves.lift(self._rig.config, await self._rig.robot.where()):
            await self.go(move)

    async def go(self, move: Move) -> None:
        """One move, to its end."""
        acc_mm_s2 = self._rig.config.motion.acc_mm_s2
        await self._rig.robot.move(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=acc_mm_s2)

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
