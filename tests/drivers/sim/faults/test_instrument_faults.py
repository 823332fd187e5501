"""Serial garbage and a bus that goes off, hung on the rig's board; the rest of the two lists is tested one by one in
tests/drivers/ink/test_station.py, tests/drivers/ink/test_pump.py and tests/drivers/force/test_sri_m8123.py."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from drivers.clock import HostClock
from drivers.errors import ConnectionLost, DeviceTimeout, ProtocolViolation, Stuck
from drivers.force.sri_m8123 import SriM8123, SriOptions
from drivers.ink.station import InkStation, StationOptions
from drivers.sim.faults.kinds import Device, Fault
from drivers.sim.instruments.force_sensor import SimForceSensor
from drivers.sim.instruments.ink_station import PtyLine, StationFirmware
from drivers.sim.rig import Faults, LoopbackRig


@pytest.fixture
async def faults(rig: LoopbackRig) -> AsyncIterator[Faults]:
    """The rig's servers with two instruments of this test's own."""
    with (
        PtyLine(StationFirmware()) as ink,
        SimForceSensor("faulty board", lambda _: (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), noise_n=0.002) as force,
    ):
        faults = Faults(rig.world, rig.arcs, rig.rtde, rig.camera, ink=ink, force=force)
        faults.line = ink.path  # type: ignore[attr-defined]
        faults.start()
        yield faults
        await faults.stop()


async def begun(faults: Faults) -> None:
    async with asyncio.timeout(2.0):
        while faults.board.hanging:
            await asyncio.sleep(0.005)


@pytest.fixture
async def station(faults: Faults) -> AsyncIterator[InkStation]:
    station = InkStation(StationOptions(faults.line, timeout_s=0.1), HostClock())  # type: ignore[attr-defined]
    await station.connect()
    yield station
    await station.close()


async def test_garbage_on_the_serial_line_is_asked_again_once(faults: Faults, station: InkStation):
    faults.hang(Fault(device=Device.INK, kind="garbage"))
    await begun(faults)
    await station.dose(0.1)


async def test_garbage_again_ends_the_dose_and_says_what_may_be_in_the_well(faults: Faults, station: InkStation):
    faults.hang(Fault(device=Device.INK, kind="garbage", count=2))
    await begun(faults)
    with pytest.raises(ProtocolViolation, match=r"Between 0 and 0\.100 ml may be in the well"):
        await station.dose(0.1)


@pytest.mark.parametrize(("kind", "error"), [("mute", DeviceTimeout), ("unplug", ConnectionLost)])
async def test_a_silent_and_an_unplugged_station_are_told_apart(
    faults: Faults, station: InkStation, kind: str, error: type[Exception]
):
    faults.hang(Fault(device=Device.INK, kind=kind, count=2))
    await begun(faults)
    with pytest.raises(error):
        await station.level()


async def until_it_fails(sensor: SriM8123) -> None:
    async with asyncio.timeout(3.0):
        while True:
            sensor.latest()
            await asyncio.sleep(0.005)


async def test_a_bus_that_goes_off_is_a_lost_connection_with_what_to_check(faults: Faults):
    sensor = SriM8123(SriOptions("virtual", "faulty board"), HostClock())
    await sensor.connect()
    faults.hang(Fault(device=Device.FORCE, kind="bus-off"))
    with pytest.raises(ConnectionLost, match="off after too many errors") as caught:
        await until_it_fails(sensor)
    assert "termination" in caught.value.remedy
    await sensor.close()


async def test_a_sensor_can_be_stuck_for_a_while(faults: Faults):
    sensor = SriM8123(SriOptions("virtual", "faulty board", stale_after_ms=1000.0), HostClock())
    await sensor.connect()
    faults.hang(Fault(device=Device.FORCE, kind="stuck", count=200))
    with pytest.raises(Stuck, match="exactly alike"):
        await until_it_fails(sensor)
    await sensor.close()


async def test_a_rig_without_the_instrument_refuses_its_faults(rig: LoopbackRig):
    bare = Faults(rig.world, rig.arcs, rig.rtde, rig.camera)
    with pytest.raises(ValueError, match="device = 'ink': this rig has none"):
        bare.hang(Fault(device=Device.INK, kind="garbage"))
