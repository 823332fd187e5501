"""Whether this computer is too busy: then frames, forces and replies come late, and no device is at fault."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from contextvars import ContextVar

TICK_S, TICKS = 0.1, 100
LATE_S = 0.25
"""Lateness of a timer, in the last ten seconds, from which on the computer is too busy: a force sensor may be silent
for 100 ms at most."""
LOAD_PER_CORE = 2.0
"""Mean load of the last minute from which on the computer is too busy: each program then waits as long as it runs."""

_late_s: ContextVar[deque[float] | None] = ContextVar("late_s", default=None)


@asynccontextmanager
async def noting_lateness() -> AsyncGenerator[None]:
    """Within the block, and in tasks that begin there, `too_busy` also knows how late the event loop's timers are."""
    late_s: deque[float] = deque(maxlen=TICKS)
    _late_s.set(late_s)

    async def tick() -> None:
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + TICK_S
            await asyncio.sleep(TICK_S)
            late_s.append(loop.time() - due_s)

    task = asyncio.create_task(tick(), name="lateness of timers")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def too_busy() -> str:
    """A sentence for the message of anything that came late, with its evidence; empty if this computer is not busy."""
    evidence: list[str] = []
    cores = os.cpu_count() or 1
    if hasattr(os, "getloadavg") and (load := os.getloadavg()[0]) >= LOAD_PER_CORE * cores:
        evidence.append(f"load {load:.1f} on {cores} cores")
    late_s = max((_late_s.get() or deque[float]()).copy(), default=0.0)
    if late_s >= LATE_S:
        evidence.append(f"a timer {late_s:.1f} s late")
    return f"This computer is too busy ({', '.join(evidence)}): end other programs first." if evidence else ""
