"""Simulated time: real time, run faster. What the world does depends on motions, never on this rate."""

from __future__ import annotations

import time


class SimClock:
    """Seconds of simulated time since the start, `rate` of them per real second."""

    def __init__(self, rate: float = 1.0) -> None:
        if not 0.0 < rate <= 1000.0:
            raise ValueError(f"rate = {rate} is outside (0, 1000]")
        self.rate = rate
        self._start = time.monotonic()

    def now_s(self) -> float:
        """Simulated seconds since this clock was made."""
        return (time.monotonic() - self._start) * self.rate
