"""Time is simulated here: no test waits, and none depends on how busy the machine is."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from tests.simulated_time import MemoryLoop


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"simulated": MemoryLoop}
