"""Waits on an engine. Each of them ends, and says what it waited for."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable

import pytest

from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.snapshot import Snapshot
from tests.waiting import PATIENCE_S

LOOK_S = 0.01
"""Between two looks at a run; a snapshot of it is not free."""


def until(engine: Engine, condition: Callable[[Snapshot], bool], timeout_s: float = PATIENCE_S) -> Snapshot:
    """The first snapshot that meets the condition; fails where it does not come in time, or the run is over."""
    deadline = time.monotonic() + timeout_s
    while not condition(now := engine.snapshot()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited {timeout_s:g} s for {_source(condition)}; the run is: {now}")
        if engine.finished:
            pytest.fail(f"the run ended while a test waited for {_source(condition)}: {now}")
        time.sleep(LOOK_S)
    return now


def wait_for_end(engine: Engine, timeout_s: float = PATIENCE_S) -> None:
    """Wait until the run is over, and raise what ended it; stops the run and fails where it does not end in time."""
    deadline = time.monotonic() + timeout_s
    while not engine.finished:
        if time.monotonic() > deadline:
            now = engine.snapshot()
            engine.stop()
            pytest.fail(f"waited {timeout_s:g} s for the end of the run; it is: {now}")
        time.sleep(LOOK_S)
    engine.join()


def _source(condition: Callable[[Snapshot], bool]) -> str:
    try:
        return inspect.getsource(condition).strip()
    except OSError:
        return repr(condition)
