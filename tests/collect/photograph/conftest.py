"""Time is simulated here: no test waits, and none depends on how busy the machine is."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from tests.simulated_time import SimulatedTimeLoop


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"simulated": SimulatedTimeLoop}


@pytest.fixture(autouse=True)
def in_this_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated time would not wait for another thread."""

    async def at_once(function: Callable[..., object], *arguments: object) -> object:
        return function(*arguments)

    monkeypatch.setattr(asyncio, "to_thread", at_once)
