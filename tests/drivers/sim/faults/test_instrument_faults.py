"""Serial garbage and a bus that goes off, hung on the rig's board; the rest of the two lists is tested one by one in
tests/drivers/ink/test_station.py, tests/drivers/ink/test_pump.py and tests/drivers/force/test_sri_m8123.py."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, ProtocolViolation, Stuck
from brushloop.drivers.force.rounds import LOOPBACK_CHANNEL
from brushloop.drivers.force.sri_m8123 import SriM8123, SriOptions
from brushloop.drivers.host import HostClock
from brushloop.drivers.ink.station import InkStation, InkStationConfig, unseal
from brushloop.drivers.sim.faults import Device, Fault
from brushloop.drivers.sim.rig import HOST, Faults, LoopbackRig


async def begun(rig: LoopbackRig) -> None:
    async with asyncio.timeout(10.0):
        while rig.faults.board.waits_by_itself:
            await asyncio.sleep(0.005)


@pytest.fixture
async def station(rig: LoopbackRig) -> AsyncIterator[InkStation]:
    assert rig.ink is not None
    station = InkStation(InkStationConfig(kind="ink-station", port=rig.ink.path), HostClock(), timeout_s=0.1)
    await station.connect()
    yield station
    await station.close()


@pytest.fixture
async def sensor(rig: LoopbackRig) -> AsyncIterator[SriM8123]:
    assert rig.force is not None
    options = SriOptions(
        "socketcand", LOOPBACK_CHANNEL, host=HOST, port=rig.force.port, stale_after_ms=5000.0, round_ms=500.0
    )
    sensor = SriM8123(options, HostClock())
    await sensor.connect()
    yield sensor
    await sensor.close()


async def test_garbage_on_the_serial_line_is_asked_again_once(rig: LoopbackRig, station: InkStation):
    assert rig.ink is not None
    firmware, asked = rig.ink.instrument, list[bytes]()
    answer = firmware.answer
    firmware.answer = lambda request: (asked.append(request), answer(request))[1]  # type: ignore[method-assign]
    before_ml = rig.world.well.ml
    rig.faults.hang(Fault(device=Device.INK, kind="garbage"))
    await begun(rig)
    await station.dose(0.1)
    assert [unseal(line).text for line in asked] == ["dose 0.100"] * 2
    assert asked[0] == asked[1], "with the same number, so that the dose is given once"
    assert rig.world.well.ml - before_ml == pytest.approx(0.1)


async def test_garbage_again_ends_the_dose_and_says_what_may_be_in_the_well(rig: LoopbackRig, station: InkStation):
    rig.faults.hang(Fault(device=Device.INK, kind="garbage", count=2))
    await begun(rig)
    with pytest.raises(ProtocolViolation, match=r"Between 0 and 0\.100 ml may be in the well"):
        await station.dose(0.1)


@pytest.mark.parametrize(("kind", "error"), [("mute", DeviceTimeout), ("unplug", ConnectionLost)])
async def test_a_silent_and_an_unplugged_station_are_distinguished(
    rig: LoopbackRig, station: InkStation, kind: str, error: type[Exception]
):
    rig.faults.hang(Fault(device=Device.INK, kind=kind, count=2))
    await begun(rig)
    with pytest.raises(error):
        await station.level()


async def until_it_fails(sensor: SriM8123) -> None:
    async with asyncio.timeout(10.0):
        while True:
            sensor.latest()
            await asyncio.sleep(0.005)


async def test_a_bus_that_goes_off_is_a_lost_connection_with_what_to_check(rig: LoopbackRig, sensor: SriM8123):
    rig.faults.hang(Fault(device=Device.FORCE, kind="bus-off"))
    with pytest.raises(ConnectionLost, match="off after too many errors") as caught:
        await until_it_fails(sensor)
    assert "termination" in caught.value.remedy


async def test_a_sensor_can_be_stuck_for_a_while(rig: LoopbackRig, sensor: SriM8123):
    rig.faults.hang(Fault(device=Device.FORCE, kind="stuck", count=1000))
    with pytest.raises(Stuck, match="exactly alike"):
        await until_it_fails(sensor)


async def test_a_sensor_that_was_silent_is_heard_again_as_soon_as_the_fault_is_cleared(
    rig: LoopbackRig, sensor: SriM8123
):
    rig.faults.hang(Fault(device=Device.FORCE, kind="silence", count=1_000_000))
    await asyncio.sleep(0.3)
    assert rig.faults.board.clear() == 1
    cleared = sensor.latest().stamp.seq
    async with asyncio.timeout(4.0):
        while sensor.latest().stamp.seq == cleared:
            await asyncio.sleep(0.005)


async def test_a_rig_without_the_instrument_refuses_its_faults(rig: LoopbackRig):
    bare = Faults(rig.world, rig.arcs, rig.rtde, rig.camera)
    with pytest.raises(ValueError, match="device = 'ink': this rig has none"):
        bare.hang(Fault(device=Device.INK, kind="garbage"))
