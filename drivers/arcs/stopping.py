"""Stop the arm over whichever connection works, until it is seen at rest.

Two connections have no common order, so a stop on its own connection may overtake a line that is still on its way.
That is why a stop is sent a second time behind that line, and why the arm is polled until it is seen at rest.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.wire import DEVICE
from brushloop.drivers.errors import DeviceError, MotionFailed
from brushloop.drivers.geometry import distance

HEDGE_S = 0.15
"""A stop that is not acknowledged within this time is sent over the next connection too."""
CONFIRM_S = 6.0
"""Rest must be seen within this time of the call: a stop from full speed takes a fraction of a second."""
RESEND_S = 0.3
POLL_S = 0.02
STILL_S = 0.1
RESTS_NEEDED = 3
"""Consecutive polls that must see rest: a line that was on its way may start after the first."""


class Stopper:
    """Stops one arm over several connections, tried in order: its own first, then those that are known to work."""

    def __init__(self, ways: list[Controller], behind: Controller, reopen: Callable[[], Awaitable[None]]) -> None:
        self._ways = ways
        self._behind = behind
        """The connection that carries the lines: a stop sent there cannot overtake one."""
        self._reopen = reopen

    async def stop(self, acc_m_s2: float) -> None:
        """Send a stop, then wait until the arm rests, sending again meanwhile; gives up after `CONFIRM_S`.

        Raises `MotionFailed`, with the condition that the arm may still be moving.
        """
        failures: list[DeviceError] = []
        trailing: asyncio.Task[None] | None = None
        # The caller must learn in time that a person has to act, however many calls hang.
        limit = asyncio.timeout(CONFIRM_S)
        try:
            async with limit:
                await self._send(acc_m_s2, failures)
                halt = self._behind.halt(acc_m_s2)
                trailing = asyncio.create_task(self._quietly(halt), name="stop behind the last line")
                await self._until_rest(acc_m_s2, failures)
                if not trailing.done():
                    await trailing  # a line is still on its way, and the arm has yet to begin it
                    await self._until_rest(acc_m_s2, failures)
        except TimeoutError:
            if not limit.expired():
                raise
            why = f": {failures[-1].what}" if failures else ""
            raise MotionFailed(
                DEVICE,
                "stop",
                f"the arm was not seen at rest within {CONFIRM_S:g} s{why}",
                condition="The arm may still be moving.",
                remedy="Use the emergency stop.",
            ) from None
        finally:
            if trailing is not None:
                trailing.cancel()
                await asyncio.gather(trailing, return_exceptions=True)

    async def _send(self, acc_m_s2: float, failures: list[DeviceError]) -> None:
        """Return once one connection has acknowledged, or all have failed."""
        pending: set[asyncio.Task[None]] = set()
        try:
            for way in self._ways:
                pending.add(asyncio.create_task(way.halt(acc_m_s2), name="stop"))
                done, pending = await asyncio.wait(pending, timeout=HEDGE_S, return_when=asyncio.FIRST_COMPLETED)
                if _acknowledged(done, failures):
                    return
            while pending:
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                if _acknowledged(done, failures):
                    return
        finally:
            for task in pending:
                task.cancel()
            await asyncio.gather(*pending, return_exceptions=True)

    async def _until_rest(self, acc_m_s2: float, failures: list[DeviceError]) -> None:
        """Return once the arm was seen at rest; otherwise run until cancelled."""
        loop = asyncio.get_running_loop()
        resend_at, rests = loop.time() + RESEND_S, 0
        proofs = self._proofs()
        while rests < RESTS_NEEDED:
            if not proofs or loop.time() > resend_at:
                await self._quietly(self._reopen())
                await self._send(acc_m_s2, failures)
                proofs, resend_at = proofs or self._proofs(), loop.time() + RESEND_S
            try:
                rests = rests + 1 if await proofs[0]() else 0
            except DeviceError as error:
                # This call fails; the next one may not.
                failures.append(error)
                rests = 0
                proofs.pop(0)
            if rests < RESTS_NEEDED:
                await asyncio.sleep(POLL_S)

    def _proofs(self) -> list[Callable[[], Awaitable[bool]]]:
        """Ways to ask whether the arm rests, the best one first."""
        return [proof for way in self._ways for proof in (way.at_rest, lambda way=way: _stands_still(way))]

    async def _quietly(self, sending: Awaitable[None]) -> None:
        with contextlib.suppress(DeviceError):
            await sending


async def _stands_still(way: Controller) -> bool:
    """Whether the tip stays where it is, for a controller that does not report its queue."""
    before = await way.pose()
    await asyncio.sleep(STILL_S)
    moved_mm, turned_deg = distance(before, await way.pose())
    return moved_mm < 0.01 and turned_deg < 0.01


def _acknowledged(done: set[asyncio.Task[None]], failures: list[DeviceError]) -> bool:
    for task in done:
        error = task.exception()
        if error is None:
            return True
        if not isinstance(error, DeviceError):
            raise error
        failures.append(error)
    return False
