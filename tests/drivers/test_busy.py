"""Where frames, forces or replies come late on a busy computer, the message says so."""

from __future__ import annotations

import asyncio
import os
import time

import pytest

from brushloop.collect.errors import CameraLate, describe
from brushloop.drivers.errors import DeviceTimeout, Stale, noting_lateness, too_busy

LATE = [
    lambda: CameraLate("the camera's delay is not steady: use a cable instead of Wi-Fi."),
    lambda: Stale("force", 130.0, 100.0),
    lambda: DeviceTimeout("robot", "getTcpPose", "no reply in 2 s"),
    lambda: DeviceTimeout("camera", "fresh", "no valid new frame", remedy="Check cable, light and stream."),
]


@pytest.mark.parametrize("late", LATE)
def test_what_comes_late_on_a_loaded_computer_says_so(late: type[Exception], monkeypatch: pytest.MonkeyPatch):
    assert "computer" not in describe(late())
    monkeypatch.setattr(os, "getloadavg", lambda: (23.0, 9.0, 3.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert "This computer is too busy (load 23.0 on 2 cores)" in describe(late())


async def test_a_program_that_is_held_up_knows_it_by_its_own_timers():
    async with noting_lateness():
        await asyncio.sleep(0.05)
        time.sleep(0.5)
        await asyncio.sleep(0.05)
        assert "a timer 0." in too_busy()
        assert "a timer 0." in await asyncio.to_thread(lambda: str(Stale("force", 130.0, 100.0)))
