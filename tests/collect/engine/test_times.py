"""The two times of a recorded sample: when the host got it, and when the device took it, both by the host's clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from brushloop.collect.engine.recorder import Recorder
from brushloop.drivers.devices import ForceSample, Stamp
from brushloop.drivers.host import HostClock
from brushloop.sessions.mcap_writer import Outgoing

MS = 1_000_000
SECOND = 1000 * MS


@dataclass
class Kept:
    """A writer that keeps what it is given."""

    messages: list[Outgoing] = field(default_factory=list[Outgoing])

    def write(self, message: Outgoing) -> None:
        self.messages.append(message)


def delays_ms(ahead_ns: list[int], delays: list[int]) -> list[float]:
    """How much earlier than the host got it each force was taken, as recorded.

    The device's clock is this far ahead of the host's, and the samples took so many ms to arrive.
    """
    kept = Kept()
    recorder = Recorder(cast(Any, kept), HostClock(), 1000.0)
    for number, (ahead, delay_ms) in enumerate(zip(ahead_ns, delays, strict=True)):
        taken_ns = 1_700_000_000 * SECOND + number * 10 * MS
        stamp = Stamp(taken_ns + delay_ms * MS, taken_ns + ahead, number)
        recorder.force(ForceSample(stamp, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
        assert kept.messages[-1].log_ns == stamp.host_ns
    return [(message.log_ns - message.publish_ns) / MS for message in kept.messages]


@pytest.mark.parametrize("ahead_s", [-1_700_000_000, -3, 0, 5])
def test_the_time_of_a_device_is_told_by_the_hosts_clock_and_never_after_its_arrival(ahead_s: int):
    delays = [4, 2, 9, 2, 30]
    assert delays_ms([ahead_s * SECOND] * 5, delays) == [0.0, 0.0, 7.0, 0.0, 28.0], "beyond the quickest so far"


def test_a_device_clock_that_starts_anew_is_mapped_anew():
    assert delays_ms([0, 0, -4000 * SECOND, -4000 * SECOND], [2, 3, 3, 5]) == [0.0, 1.0, 0.0, 2.0]
