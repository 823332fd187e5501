"""The clock of the host, and what is said when the computer is too busy."""

from __future__ import annotations

import os
import time

import pytest

from brushloop.collect.errors import CameraLate, describe
from brushloop.drivers.errors import DeviceTimeout, Stale
from brushloop.drivers.host import HostClock


def test_the_host_clock_goes_on_when_wall_time_is_set_back(monkeypatch: pytest.MonkeyPatch):
    clock = HostClock()
    before = clock.now_ns()
    hour_ago = time.time_ns() - 3600 * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: hour_ago)
    readings = [clock.now_ns() for _ in range(100)]
    assert before <= readings[0]
    assert readings == sorted(readings)
    assert readings[-1] - before < 10**9


LATE = [
    lambda: CameraLate("the camera's delay is not steady: use a cable instead of Wi-Fi."),
    lambda: Stale("force", 130.0, 100.0),
    lambda: DeviceTimeout("camera", "fresh", "no valid new frame", remedy="Check cable, light and stream."),
]


@pytest.mark.parametrize("late", LATE)
def test_what_comes_late_on_a_loaded_computer_says_so(late: type[Exception], monkeypatch: pytest.MonkeyPatch):
    assert "computer" not in describe(late())
    monkeypatch.setattr(os, "getloadavg", lambda: (23.0, 9.0, 3.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert "This computer is too busy (load 23.0 on 2 cores)" in describe(late())
