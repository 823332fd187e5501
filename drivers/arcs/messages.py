"""What the controller says of a plan that failed: it accepts the command and leaves a message."""

from __future__ import annotations

import contextlib
from typing import Any

from drivers.arcs.controller import Controller
from drivers.arcs.errors import OutOfReach
from drivers.arcs.rpc import DEVICE
from drivers.errors import DeviceError, MotionFailed

PLANNING_FAILED = {30047: "pose out of reach", 30048: "planning failed"}
NEWEST = 20


class Messages:
    """The controller's messages since `begin`."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._seen = 0
        """The controller's own stamp; its unit is not known, its order is."""

    async def begin(self) -> None:
        """Forget what is already there; it is about somebody else's motion."""
        await self._new()

    async def explain(self, error: MotionFailed) -> MotionFailed:
        """`OutOfReach` where a new message says so, else the error itself."""
        for code in await self._new():
            if code in PLANNING_FAILED:
                return OutOfReach(DEVICE, error.op, code, PLANNING_FAILED[code])
        return error

    async def _new(self) -> list[int]:
        """Codes of the messages that were not seen before; none where the controller cannot tell."""
        found: Any = []
        with contextlib.suppress(DeviceError):
            found = await self._controller.ask("Trace.peek", num=NEWEST, last_time=self._seen)
        codes: list[int] = []
        newest = self._seen
        for message in found if isinstance(found, list) else []:  # pyright: ignore[reportUnknownVariableType]
            match message:
                case {"code": int(code), "timestamp": int(stamp)} if stamp > self._seen:
                    codes.append(code)
                    newest = max(newest, stamp)
                case _:  # pyright: ignore[reportUnknownVariableType]
                    pass
        self._seen = newest
        return codes
