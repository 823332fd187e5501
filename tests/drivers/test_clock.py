import time

import pytest

from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.world import SimClock


def test_the_host_clock_gives_wall_time():
    assert abs(HostClock().now_ns() - time.time_ns()) < 50_000_000


def test_the_host_clock_goes_on_when_wall_time_is_set_back(monkeypatch: pytest.MonkeyPatch):
    clock = HostClock()
    before = clock.now_ns()
    hour_ago = time.time_ns() - 3600 * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: hour_ago)
    readings = [clock.now_ns() for _ in range(100)]
    assert before <= readings[0]
    assert readings == sorted(readings)
    assert readings[-1] - before < 10**9


def test_the_simulated_clock_runs_at_its_rate():
    clock = SimClock(rate=100.0)
    began, real = clock.now_s(), time.monotonic()
    time.sleep(0.02)
    elapsed, most = clock.now_s() - began, (time.monotonic() - real) * 100.0
    assert 2.0 <= elapsed <= most + 1.0


@pytest.mark.parametrize("rate", [0.0, -1.0, 1000.1, float("nan")])
def test_a_rate_that_makes_no_sense_is_refused(rate: float):
    with pytest.raises(ValueError, match="rate"):
        SimClock(rate)
