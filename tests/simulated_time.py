"""An event loop in which time is simulated: it passes only while every task waits, and then jumps to the next timer."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable

STEP_S = 1e-6
"""Time that passes at least between two looks at what is ready, so that a wait for the next moment ends."""
LATENCY_S = 2e-4
"""The same where there are sockets: a call over a network takes a few of these."""
SETTLE_SHARE = 0.05
"""Share of a jump that is really waited for where there are sockets: a busy system may deliver a little later."""


class _Jumping(selectors.SelectSelector):
    """Instead of waiting, it says how long it would have waited."""

    def __init__(self, waited: Callable[[float], None]) -> None:
        super().__init__()
        self._waited = waited

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(None if timeout is None else 0.0)
        step_s = STEP_S
        if len(self.get_map()) > 1:  # the first is the loop's own
            step_s = LATENCY_S
            if not ready and timeout:
                ready = super().select(SETTLE_SHARE * timeout)
        self._waited(step_s if ready or timeout is None else max(timeout, step_s))
        return ready


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """For tests without threads and other processes, which are not waited for."""

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
