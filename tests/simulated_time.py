"""An event loop in which time is simulated: it passes only while every task waits, and then jumps to the next timer."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable

STEP_S = 1e-6
"""Time that passes at least between two looks at what is ready, so that a wait for the next moment ends."""


class _Jumping(selectors.SelectSelector):
    """Instead of waiting, it says how long it would have waited."""

    def __init__(self, waited: Callable[[float], None]) -> None:
        super().__init__()
        self._waited = waited

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(None if timeout is None else 0.0)
        self._waited(STEP_S if ready or timeout is None else max(timeout, STEP_S))
        return ready


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """For tests without threads and sockets: neither is waited for."""

    def __init__(self) -> None:
        self._now_s = 1000.0
        super().__init__(_Jumping(self._pass))

    def time(self) -> float:
        return self._now_s

    def _pass(self, s: float) -> None:
        self._now_s += s


class LoopClock:
    """A `Clock` that reads the running loop's time."""

    def now_ns(self) -> int:
        return round(1e9 * asyncio.get_running_loop().time())
