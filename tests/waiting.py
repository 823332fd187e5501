"""Waits of tests: each of them ends, and says what it waited for."""

from __future__ import annotations

import asyncio
import subprocess
import time
from collections.abc import Callable
from typing import Any

import pytest

PATIENCE_S = 200.0
"""On a busy machine; less than the time-out of a test, whose message would not say as much."""


def wait_until(
    condition: Callable[[], object],
    what: str,
    *,
    process: subprocess.Popen[Any] | None = None,
    timeout_s: float = PATIENCE_S,
) -> None:
    """Wait until the condition holds; fails where it does not in time, or where the process that is to meet it ends."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if process is not None and process.poll() is not None:
            pytest.fail(f"the process ended with {process.returncode} while a test waited for {what}")
        if time.monotonic() > deadline:
            pytest.fail(f"waited {timeout_s:g} s for {what}")
        time.sleep(0.005)


async def until(condition: Callable[[], object], what: str, *, timeout_s: float = PATIENCE_S) -> None:
    """Wait in the event loop until the condition holds; fails where it does not in time."""
    try:
        async with asyncio.timeout(timeout_s):
            while not condition():
                await asyncio.sleep(0.005)
    except TimeoutError:
        pytest.fail(f"waited {timeout_s:g} s for {what}")
