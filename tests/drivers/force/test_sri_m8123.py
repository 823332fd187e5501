"""The force driver against a board on a virtual bus: what it reads, what it refuses, and how it ends."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from itertools import count, pairwise

import can
import pytest
from can.interfaces.virtual import VirtualBus

from brushloop.drivers.devices import ForceSample, ForceSensor
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    NotConnected,
    Stale,
    Stuck,
)
from brushloop.drivers.force.rounds import Wrench
from brushloop.drivers.force.sri_m8123 import SriM8123, SriOptions
from brushloop.drivers.host import HostClock
from tests.drivers.force.virtual_board import SimForceSensor

WRENCH: Wrench = (1.0, -2.0, 3.5, 0.25, -0.5, 0.125)
NUMBERS = count()
RATE_HZ = 100.0


@pytest.fixture
def channel() -> str:
    return f"force-{next(NUMBERS)}"


@pytest.fixture
def board(channel: str) -> Iterator[SimForceSensor]:
    with SimForceSensor(channel, lambda _: WRENCH, rate_hz=RATE_HZ) as it:
        yield it


def sensor_on(channel: str, **options: float) -> SriM8123:
    # round_ms is wide: on a busy machine the simulated board may pause within a round.
    # Most boards here measure without noise.
    steady = {"round_ms": 200.0, "stale_after_ms": 250.0, "stuck_after_ms": math.inf}
    made = SriOptions("virtual", channel, **{**steady, **options})
    return SriM8123(made, HostClock())


@pytest.fixture
async def sensor(board: SimForceSensor) -> AsyncIterator[SriM8123]:
    it = sensor_on(board.channel)
    await it.connect()
    yield it
    await it.close()


async def until(met: Callable[[], bool], limit_s: float = 60.0) -> None:
    async with asyncio.timeout(limit_s):
        while not met():
            await asyncio.sleep(0.005)


def readers() -> int:
    return sum(t.name == "force reader" for t in threading.enumerate())


async def test_connecting_starts_the_board_and_closing_stops_it(board: SimForceSensor):
    sensor = sensor_on(board.channel)
    assert isinstance(sensor, ForceSensor)
    identity = await sensor.connect()
    assert identity.model.startswith("SRI M8123B2 on Virtual bus")
    assert identity.simulated
    assert sensor.latest_n() == WRENCH[:3]
    assert sensor.latest().torque_nm == WRENCH[3:]
    await sensor.close()
    await until(lambda: board.commands == [b"\x02", b"\x00"])
    assert not board.streaming
    assert readers() == 0
    with pytest.raises(NotConnected):
        sensor.latest_n()
    await sensor.close()


async def test_the_wire_is_read_as_written(channel: str):
    """The same bytes as a candump of a board would show, sent by hand."""
    with can.Bus(channel, "virtual", ignore_config=True) as bus:

        def play() -> None:
            start = bus.recv(2.0)
            assert start is not None
            assert (start.arbitration_id, bytes(start.data), start.is_extended_id) == (0x80, b"\x02", False)
            for can_id, data in (
                (0x291, "00 00 80 3f 00 00 00 c0"),
                (0x292, "00 00 60 40 00 00 80 3e"),
                (0x293, "00 00 00 bf 00 00 00 3e"),
            ):
                bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=bytes.fromhex(data)))

        playing = asyncio.create_task(asyncio.to_thread(play))
        sensor = sensor_on(channel)
        await sensor.connect()
        await playing
        assert sensor.latest_n() == (1.0, -2.0, 3.5)
        await sensor.close()
        stop = bus.recv(1.0)
        assert stop is not None
        assert bytes(stop.data) == b"\x00"


async def test_samples_are_stamped_and_counted_and_reach_the_listener_in_the_loop(sensor: SriM8123):
    seen: list[ForceSample] = []
    loops: set[object] = set()

    def listener(sample: ForceSample) -> None:
        seen.append(sample)
        loops.add(asyncio.get_running_loop())

    before_ns = time.time_ns() - 50_000_000
    sensor.listen(listener)
    await until(lambda: len(seen) >= 10)
    sensor.listen(None)
    size = len(seen)
    await asyncio.sleep(0.05)
    assert len(seen) == size
    assert loops == {asyncio.get_running_loop()}
    assert [s.stamp.seq for s in seen] == list(range(seen[0].stamp.seq, seen[0].stamp.seq + size))
    for earlier, later in pairwise(seen):
        assert before_ns < earlier.stamp.host_ns < later.stamp.host_ns
        assert earlier.stamp.device_ns is not None
        assert abs(earlier.stamp.host_ns - earlier.stamp.device_ns) < 10**9


async def test_no_sample_is_delivered_after_close(board: SimForceSensor, sensor: SriM8123):
    seen: list[ForceSample] = []
    sensor.listen(seen.append)
    await until(lambda: bool(seen))
    await sensor.close()
    size = len(seen)
    await asyncio.sleep(0.05)
    assert len(seen) == size


async def test_silence_makes_the_sample_stale(board: SimForceSensor, sensor: SriM8123):
    board.fail(*["silence"] * 40)
    await asyncio.sleep(0.35)
    with pytest.raises(Stale) as stale:
        sensor.latest_n()
    assert stale.value.age_ms > 250.0
    before = sensor.health().rounds
    await until(lambda: sensor.health().rounds > before)
    assert sensor.latest_n() == WRENCH[:3]


async def test_a_sensor_that_says_the_same_again_and_again_is_named_as_stuck(channel: str):
    with SimForceSensor(channel, lambda _: WRENCH, rate_hz=200.0, noise_n=0.002, noise_nm=2e-4) as board:
        sensor = sensor_on(board.channel, stuck_after_ms=100.0)
        await sensor.connect()
        await asyncio.sleep(0.2)
        assert sensor.latest_n() == pytest.approx(WRENCH[:3], abs=0.02)
        board.fail(*["stuck"] * 60)
        with pytest.raises(Stuck, match=r"the sensor is stuck: \d\d samples in \d+ ms were exactly alike.*off and on"):
            await until(lambda: sensor.latest_n() is None)
        before = sensor.health().rounds
        await until(lambda: sensor.health().rounds > before + 70)
        assert sensor.latest_n()
        await sensor.close()


async def test_what_is_no_number_is_refused_and_goes_stale(board: SimForceSensor, sensor: SriM8123):
    seen: list[ForceSample] = []
    sensor.listen(seen.append)
    board.fail(*["nan", "inf"] * 20)
    await asyncio.sleep(0.35)
    with pytest.raises(Stale):
        sensor.latest_n()
    assert sensor.health().refused >= 20
    assert all(math.isfinite(value) for s in seen for value in (*s.force_n, *s.torque_nm))


async def test_bus_off_is_a_lost_connection_that_says_what_to_do(board: SimForceSensor, sensor: SriM8123):
    board.fail("bus-off")
    await until(lambda: sensor.health().bus_errors == 1)
    await until(lambda: readers() == 0)
    for use in (sensor.latest_n, sensor.latest):
        with pytest.raises(ConnectionLost, match=r"off after too many errors.*termination.*1000000 bit/s"):
            use()
    with pytest.raises(ConnectionLost):
        await sensor.bias(0.1)
    await sensor.connect()
    assert sensor.latest_n() == WRENCH[:3]


async def test_a_bus_error_is_counted_and_lived_with(board: SimForceSensor, sensor: SriM8123):
    board.fail("bus-error", "bus-error")
    await until(lambda: sensor.health().bus_errors == 2)
    assert sensor.latest_n() == WRENCH[:3]


@pytest.mark.parametrize("error", [can.CanOperationError("network is down", 100), OSError(19, "No such device")])
async def test_an_adapter_that_goes_away_is_a_lost_connection(
    error: Exception, sensor: SriM8123, monkeypatch: pytest.MonkeyPatch
):
    real = VirtualBus.recv

    def recv(bus: VirtualBus, timeout: float | None = None) -> can.Message | None:
        if threading.current_thread().name == "force reader":
            raise error
        return real(bus, timeout)

    monkeypatch.setattr(VirtualBus, "recv", recv)
    await until(lambda: readers() == 0)
    with pytest.raises(ConnectionLost, match=r"bus virtual force-\d+ failed: .*connect again"):
        sensor.latest_n()


async def test_a_controller_that_reports_bus_off_only_when_asked(
    board: SimForceSensor, sensor: SriM8123, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("can.BusABC.state", can.BusState.ERROR)
    board.fail(*["silence"] * 20)
    await until(lambda: readers() == 0)
    with pytest.raises(ConnectionLost, match="is off"):
        sensor.latest_n()


async def test_where_no_board_answers_the_connection_times_out(channel: str):
    sensor = sensor_on(channel, connect_timeout_s=0.2)
    with pytest.raises(DeviceTimeout, match=r"no whole round in 0.2 s \(0 torn, 0 refused\).*termination"):
        await sensor.connect()
    assert readers() == 0
    with pytest.raises(NotConnected):
        sensor.health()


@pytest.mark.parametrize("interface", ["socketcan", "no-such-interface", "pcan"])
async def test_an_adapter_that_is_not_there_is_a_lost_connection(interface: str):
    sensor = SriM8123(SriOptions(interface, "can9"), HostClock())
    with pytest.raises(ConnectionLost, match=f"cannot open {interface} can9"):
        await sensor.connect()
    assert readers() == 0


async def test_a_bias_is_subtracted_from_now_on(channel: str):
    load: list[Wrench] = [WRENCH]
    with SimForceSensor(channel, lambda _: load[0], rate_hz=200.0, noise_n=0.02, noise_nm=0.002) as board:
        sensor = sensor_on(board.channel)
        await sensor.connect()
        await sensor.bias(0.4)
        assert sensor.latest_n() == pytest.approx((0.0, 0.0, 0.0), abs=0.1)
        assert sensor.bias_wrench == pytest.approx(WRENCH, abs=0.02)
        seen: list[ForceSample] = []
        load[0] = (1.0, -2.0, 8.5, 0.25, -0.5, 0.125)
        sensor.listen(seen.append)
        await until(lambda: len(seen) > 5)
        assert seen[-1].force_n == pytest.approx((0.0, 0.0, 5.0), abs=0.1)
        await sensor.close()


@pytest.mark.parametrize(("axis", "size", "says"), [(2, 1.0, "Fz varied"), (3, 0.1, "Mx varied")])
async def test_a_bias_while_something_moves_is_refused(channel: str, axis: int, size: float, says: str):
    def shake(t_s: float) -> Wrench:
        values = list(WRENCH)
        values[axis] += size * math.sin(50.0 * t_s)
        fx, fy, fz, mx, my, mz = values
        return (fx, fy, fz, mx, my, mz)

    with SimForceSensor(channel, shake) as board:
        sensor = sensor_on(board.channel)
        await sensor.connect()
        with pytest.raises(DeviceError, match=rf"{says}.*The previous bias remains.*try again"):
            await sensor.bias(0.2)
        assert sensor.bias_wrench == (0.0,) * 6
        await sensor.close()


async def test_where_too_few_rounds_came_a_bias_averages_longer(sensor: SriM8123):
    await sensor.bias(0.02)
    assert sensor.bias_wrench != (0.0,) * 6


async def test_a_bias_over_silence_is_refused(board: SimForceSensor, sensor: SriM8123, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("brushloop.drivers.force.sri_m8123.MORE_BIAS_S", 0.0)
    board.fail(*["silence"] * 60)
    with pytest.raises(Stale):
        await sensor.bias(0.4)


async def test_closing_while_averaging_ends_in_an_error(sensor: SriM8123):
    averaging = asyncio.create_task(sensor.bias(0.1))
    await asyncio.sleep(0.02)
    await sensor.close()
    with pytest.raises(NotConnected, match="closed while averaging"):
        await averaging
