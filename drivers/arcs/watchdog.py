"""The controller's watchdog: a host that dies leaves an arm in a protective stop, not in motion.

How a real cabinet wants it to be fed is not known; here it is set again, which is what its description suggests. If
that were wrong the arm would stop soon after it was enabled, which is safe and plain to see.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from drivers.arcs.codes import ReturnCode
from drivers.arcs.rpc import RpcConnection
from drivers.errors import DeviceError, RpcError

KEY = "brushloop"
NOTHING, PROTECTIVE_STOP = 0, 3
FEEDINGS = 4
"""Per timeout: three may be lost."""


class Watchdog:
    """Armed while the arm is enabled; fed over the connection that telemetry uses."""

    def __init__(self, connection: RpcConnection, timeout_s: float | None, on_notice: Callable[[str], None]) -> None:
        self._connection = connection
        self._timeout_s = timeout_s
        self._notice = on_notice
        self._feeding: asyncio.Task[None] | None = None

    @property
    def armed(self) -> bool:
        """True from an accepted `arm` to `disarm`."""
        return self._feeding is not None

    async def arm(self) -> None:
        """Arm it and go on feeding it; a controller without one is reported, not refused."""
        if self.armed or self._timeout_s is None:
            return
        try:
            code = await self._set(self._timeout_s, PROTECTIVE_STOP)
        except RpcError as error:
            self._notice(f"no watchdog: {error.what}")
            return
        if code != ReturnCode.OK:
            self._notice(f"no watchdog: the controller refused it with {code}")
            return
        self._feeding = asyncio.create_task(self._feed(self._timeout_s), name="robot watchdog")

    async def disarm(self) -> None:
        """End feeding, and tell the controller. Where it cannot be told, the watchdog bites: the arm stops."""
        if self.armed and self._timeout_s is not None:
            await self.abandon()
            with contextlib.suppress(DeviceError):
                await self._set(self._timeout_s, NOTHING)

    async def abandon(self) -> None:
        """End feeding and leave it armed, so that it bites."""
        feeding, self._feeding = self._feeding, None
        if feeding is not None:
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)

    async def _feed(self, timeout_s: float) -> None:
        while True:
            await asyncio.sleep(timeout_s / FEEDINGS)
            # What fails here fails for telemetry too, and shows there; the controller stops the arm by itself.
            with contextlib.suppress(DeviceError):
                await self._set(timeout_s, PROTECTIVE_STOP)

    async def _set(self, timeout_s: float, action: int) -> object:
        params = {"key": KEY, "timeout": timeout_s, "action": action}
        return await self._connection.call("RegisterControl.setWatchDog", params)
