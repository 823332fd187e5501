"""How steadily samples came during a step, and which of its own sections were slow."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Generator
from contextlib import contextmanager

from sessions.recording.schemas import Cadence, SlowSection, Topic

SLOW_MS = 250.0
"""A section that takes longer is named: an operator waits for it."""


class Arrivals:
    """One topic: counts slots of 1 / `expected_hz` in which nothing came."""

    def __init__(self, topic: Topic, expected_hz: float) -> None:
        self._topic = topic
        self._expected_hz = expected_hz
        self._received = 0
        self._missed = 0
        self._last_ns: int | None = None
        self._longest_ns = 0

    def arrived(self, host_ns: int) -> None:
        """A sample came at `host_ns`."""
        self._received += 1
        if self._last_ns is not None:
            gap_ns = host_ns - self._last_ns
            self._longest_ns = max(self._longest_ns, gap_ns)
            # Half a slot late is late, not missed.
            self._missed += max(0, round(gap_ns * self._expected_hz / 1e9) - 1)
        self._last_ns = host_ns

    def report(self, slow: tuple[SlowSection, ...] = ()) -> Cadence | None:
        """What to record; None where nothing ever came."""
        if not self._received:
            return None
        return Cadence(
            topic=self._topic,
            expected_hz=self._expected_hz,
            received=self._received,
            missed=self._missed,
            longest_gap_ms=self._longest_ns / 1e6 if self._received > 1 else None,
            slow_sections=slow,
        )


class Sections:
    """Wall time of named sections of one step."""

    def __init__(self) -> None:
        self._slow_ms: defaultdict[str, list[float]] = defaultdict(list)

    @contextmanager
    def timed(self, name: str) -> Generator[None]:
        """Time the block; only one slower than `SLOW_MS` is kept."""
        began_s = time.perf_counter()
        try:
            yield
        finally:
            took_ms = (time.perf_counter() - began_s) * 1e3
            if took_ms > SLOW_MS:
                self._slow_ms[name].append(took_ms)

    def report(self) -> tuple[SlowSection, ...]:
        """The slow ones."""
        return tuple(
            SlowSection(name=name, times=len(took), longest_ms=max(took)) for name, took in self._slow_ms.items()
        )
