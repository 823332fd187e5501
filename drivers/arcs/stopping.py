"""Stopping the arm: over whichever connection works, and not believed until the arm rests.

Two connections have no common order, so a stop on its own connection may overtake a line that is still on its way.
That is why a stop is sent a second time behind that line, and why rest is asked for until it is seen.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

from drivers.arcs.controller import Controller
from drivers.arcs.rpc import DEVICE
from drivers.errors import DeviceError, MotionFailed
from drivers.geometry import distance

HEDGE_S = 0.15
"""A stop that is not acknowledged by then goes out over the next connection too."""
CONFIRM_S = 6.0
"""Rest must be seen within this time: a stop from full speed takes a fraction of a second."""
RESEND_S = 0.3
POLL_S = 0.02
STILL_S = 0.1
RESTS_NEEDED = 3
"""So many polls in a row: a line that was on its way may start after the first."""


class Stopper:
    """Stops one arm. `ways` are tried in order: its own connection first, then those that are known to work."""

    def __init__(self, ways: list[Controller], behind: Controller, reopen: Callable[[], Awaitable[None]]) -> None:
        self._ways = ways
        self._behind = behind
        """The connection that lines go out on: a stop there cannot overtake one."""
        self._reopen = reopen

    async def stop(self, acc_m_s2: float) -> None:
        """Send, then wait until the arm rests, sending again meanwhile.

        Raises `MotionFailed` saying that the arm may still be moving.
        """
        failure = await self._send(acc_m_s2)
        trailing = asyncio.create_task(self._quietly(self._behind.halt(acc_m_s2)), name="stop behind the last line")
        try:
            await self._until_rest(acc_m_s2, failure)
        finally:
            trailing.cancel()
            await asyncio.gather(trailing, return_exceptions=True)

    async def _send(self, acc_m_s2: float) -> DeviceError | None:
        """None once one connection has acknowledged; else the last failure."""
        pending: set[asyncio.Task[None]] = set()
        failure: DeviceError | None = None
        try:
            for way in self._ways:
                pending.add(asyncio.create_task(way.halt(acc_m_s2), name="stop"))
                done, pending = await asyncio.wait(pending, timeout=HEDGE_S, return_when=asyncio.FIRST_COMPLETED)
                acknowledged, failure = _outcome(done, failure)
                if acknowledged:
                    return None
            while pending:
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                acknowledged, failure = _outcome(done, failure)
                if acknowledged:
                    return None
            return failure
        finally:
            for task in pending:
                task.cancel()
            await asyncio.gather(*pending, return_exceptions=True)

    async def _until_rest(self, acc_m_s2: float, failure: DeviceError | None) -> None:
        loop = asyncio.get_running_loop()
        deadline, resend_at, rests = loop.time() + CONFIRM_S, loop.time() + RESEND_S, 0
        proofs = self._proofs()
        while loop.time() < deadline:
            if not proofs or loop.time() > resend_at:
                await self._quietly(self._reopen())
                failure = await self._send(acc_m_s2) or failure
                proofs, resend_at = proofs or self._proofs(), loop.time() + RESEND_S
            try:
                rests = rests + 1 if await proofs[0]() else 0
            except DeviceError as error:
                # This question gets no answer; the next one may.
                failure, rests = error, 0
                proofs.pop(0)
            if rests >= RESTS_NEEDED:
                return
            await asyncio.sleep(POLL_S)
        why = f": {failure.what}" if failure is not None else ""
        raise MotionFailed(
            DEVICE,
            "stop",
            f"the arm was not seen at rest within {CONFIRM_S:g} s{why}",
            condition="The arm may still be moving.",
            remedy="Use the emergency stop.",
        )

    def _proofs(self) -> list[Callable[[], Awaitable[bool]]]:
        """Ways to ask whether the arm rests, the best one first."""
        return [proof for way in self._ways for proof in (way.at_rest, lambda way=way: _stands_still(way))]

    async def _quietly(self, sending: Awaitable[None]) -> None:
        with contextlib.suppress(DeviceError):
            await sending


async def _stands_still(way: Controller) -> bool:
    """Whether the tip moves, for a controller that does not answer what its queue does."""
    before = await way.pose()
    await asyncio.sleep(STILL_S)
    moved_mm, turned_deg = distance(before, await way.pose())
    return moved_mm < 0.01 and turned_deg < 0.01


def _outcome(done: set[asyncio.Task[None]], failure: DeviceError | None) -> tuple[bool, DeviceError | None]:
    for task in done:
        error = task.exception()
        if error is None:
            return True, failure
        if not isinstance(error, DeviceError):
            raise error
        failure = error
    return False, failure
