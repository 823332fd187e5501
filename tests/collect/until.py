"""Waiting for what an engine's snapshot shows."""

from __future__ import annotations

import time
from collections.abc import Callable

from collect.engine.engine import Engine
from collect.engine.snapshot import Snapshot


def until(engine: Engine, condition: Callable[[Snapshot], bool], timeout_s: float = 30.0) -> Snapshot:
    """The first snapshot that meets the condition; fails where it does not come in time, or the run is over."""
    deadline = time.monotonic() + timeout_s
    while not condition(now := engine.snapshot()):
        assert time.monotonic() < deadline, f"waited in vain: {now}"
        assert not engine.finished, f"over too early: {now}"
        time.sleep(0.005)
    return now
