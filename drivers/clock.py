"""The host clock: wall-clock nanoseconds that never step backwards within a process."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """A source of nanoseconds since the epoch that never goes backwards."""

    def now_ns(self) -> int:
        """Nanoseconds since 1970-01-01 UTC; never less than the value returned before."""
        ...


class HostClock:
    """Wall time read once, then carried forward by the monotonic clock.

    An NTP step or an operator who sets the clock during a session must not reorder a recording.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Nanoseconds since the epoch: wall time when this clock was created, plus monotonic time since."""
        return self._offset_ns + time.monotonic_ns()
