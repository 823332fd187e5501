"""How much ink may flow: checked before anything is sent, counted whether or not the device confirms it."""

from __future__ import annotations

import math
from collections import deque

from drivers.errors import LimitExceeded

MINUTE_NS = 60 * 10**9


class DoseBudget:
    """A limit per dose and one per minute, both in ml.

    A dose that failed still counts: ink may have flowed before the reply was lost.
    """

    def __init__(self, device: str, *, smallest_ml: float, max_dose_ml: float, max_per_minute_ml: float) -> None:
        self._device = device
        self._smallest_ml = smallest_ml
        self._max_dose_ml = max_dose_ml
        self._max_per_minute_ml = max_per_minute_ml
        self._given: deque[tuple[int, float]] = deque()

    def take(self, volume_ml: float, now_ns: int) -> None:
        """Count a dose at `now_ns`. Raises `LimitExceeded`, and then counts nothing."""
        if not math.isfinite(volume_ml) or not self._smallest_ml * (1 - 1e-9) <= volume_ml <= self._max_dose_ml:
            raise LimitExceeded(self._device, "dose", volume_ml, self._smallest_ml, self._max_dose_ml, "ml")
        while self._given and now_ns - self._given[0][0] >= MINUTE_NS:
            self._given.popleft()
        within_ml = volume_ml + sum(ml for _, ml in self._given)
        if within_ml > self._max_per_minute_ml * (1 + 1e-9):
            raise LimitExceeded(self._device, "dose per minute", within_ml, 0.0, self._max_per_minute_ml, "ml")
        self._given.append((now_ns, volume_ml))
