"""Checks before a line is sent: the arm rests where it was left, has the same settings, and may move the whole way.

Another client may have used the arm since the last line, so everything is checked again.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Sequence

from brushloop.drivers.arcs.codes import RobotMode
from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.rpc import DEVICE
from brushloop.drivers.arcs.settings import Settings, read_back, require_same
from brushloop.drivers.errors import ArmMoved, NotConnected, NotPowered
from brushloop.drivers.geometry import distance
from brushloop.drivers.limits import Limits
from brushloop.drivers.samples import Pose

MOVED_MM, MOVED_DEG = 0.5, 0.5
"""Limits beyond which another client or a person moved the arm: larger than the tolerance of any settled move."""
DOWN_MM = 0.01
"""A line that ends more than this lower counts as going down."""
RESTS_S, POLL_S = 0.5, 0.02
"""Longest wait for rest, and interval of the checks: an arm that has just settled may take a moment to report it."""


class Departure:
    """Place and settings in which one arm was left."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._settings: Settings = {}
        self.left: Pose | None = None
        """Where the last line ended, or where `take_up` found the arm; None after a line that did not reach its end."""

    async def enabled(self, settings: Settings) -> None:
        """Note the settings with which the arm was enabled, and its place."""
        self._settings = settings
        self.left = await self._controller.pose()

    async def take_up(self) -> Pose:
        """Accept the place where the arm rests as the start of the next line.

        Raises `ArmMoved` while it moves, `SettingsChanged` if a pose would refer to another tool, `RobotNotSafe`,
        `NotPowered`.
        """
        await self._require_rest("take up")
        await self._require_settings("take up")
        self.left = await self._controller.pose()
        return self.left

    async def confirm(self) -> None:
        """Check that all is as it was left. Raises `RobotNotSafe`, `NotPowered`, `SettingsChanged`, then `ArmMoved`."""
        await self._require_settings("confirm")
        await self._require_rest("confirm")
        self._require_place("confirm", await self._controller.pose())

    async def ready(self, op: str, limits: Limits, poses: Sequence[Pose]) -> Pose:
        """Return where the arm is, once it may go from there through `poses`.

        Raises as `confirm` does, and `LimitExceeded` if a line would leave the limits.
        """
        await self._require_rest(op)
        start = await self._controller.pose()
        way = [start, *poses]
        down = any(b.z_mm < a.z_mm - DOWN_MM for a, b in itertools.pairwise(way))
        if down or self._moved(start):
            await self._require_settings(op)  # with another tool, the same place would look like another
        self._require_place(op, start)
        for a, b in itertools.pairwise(way):
            limits.check_way(DEVICE, a, b)
        return start

    async def _require_settings(self, op: str) -> None:
        self._require_enabled(op)
        found = await read_back(self._controller)
        await self._controller.require_safe(op)
        if await self._controller.mode() != RobotMode.RUNNING:
            raise NotPowered(DEVICE, op)
        require_same(op, self._settings, found)

    async def _require_rest(self, op: str) -> None:
        self._require_enabled(op)
        loop = asyncio.get_running_loop()
        until = loop.time() + RESTS_S
        while not await self._controller.at_rest():
            if loop.time() > until:
                await self._controller.require_safe(op)  # a safety stop holds its path: that is the cause to report
                raise ArmMoved(DEVICE, op, *self._off(await self._controller.pose()), moving=True)
            await asyncio.sleep(POLL_S)

    def _require_enabled(self, op: str) -> None:
        if not self._settings:
            raise NotConnected(DEVICE, op, "not enabled")

    def _require_place(self, op: str, here: Pose) -> None:
        if self._moved(here):
            raise ArmMoved(DEVICE, op, *self._off(here))

    def _moved(self, here: Pose) -> bool:
        off_mm, off_deg = self._off(here)
        return off_mm > MOVED_MM or off_deg > MOVED_DEG

    def _off(self, here: Pose) -> tuple[float, float]:
        return (0.0, 0.0) if self.left is None else distance(self.left, here)
