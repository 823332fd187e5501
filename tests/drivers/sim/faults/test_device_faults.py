"""What the drivers of telemetry and instruments do while a fault lasts."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import ArcsOptions
from brushloop.drivers.devices import PoseSample
from brushloop.drivers.errors import Stale
from brushloop.drivers.force.rounds import LOOPBACK_CHANNEL
from brushloop.drivers.force.sri_m8123 import SriM8123, SriOptions
from brushloop.drivers.host import HostClock
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault, FaultBoard
from brushloop.drivers.sim.rig import HOST, LoopbackRig


@pytest.mark.parametrize(
    ("kind", "words"),
    [("mute", "no sample"), ("malformed", "neither CBOR nor JSON"), ("drop", "closed the connection")],
)
async def test_a_stream_that_fails_is_reported_once_and_poses_go_on(
    rig: LoopbackRig, limits: Limits, kind: str, words: str
):
    notices: list[str] = []
    options = ArcsOptions(HOST, rig.arcs.port, (0.0, 0.0, 180.0), rtde_port=rig.rtde.port)
    arm = AuboArcs(options, limits, HostClock(), notices.append)
    assert (await arm.connect()).firmware.endswith("telemetry by RTDE")
    rig.faults.hang(Fault(device=Device.TELEMETRY, kind=kind, count=ALWAYS))
    async with asyncio.timeout(3.0):
        while not notices:
            await asyncio.sleep(0.02)
    samples: list[PoseSample] = []
    arm.listen(samples.append)
    async with asyncio.timeout(3.0):
        while len(samples) < 3:
            await asyncio.sleep(0.02)
    arm.latest()
    [notice] = notices
    assert "polled instead of pushed" in notice
    assert words in notice

    rig.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))  # and where that fails too
    await asyncio.sleep(0.7)
    with pytest.raises(Stale):
        arm.latest()
    await arm.close()


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


async def test_a_sensor_that_was_silent_is_heard_again_as_soon_as_the_fault_is_cleared(
    rig: LoopbackRig, sensor: SriM8123
):
    rig.faults.hang(Fault(device=Device.FORCE, kind="silence", count=1_000_000))
    await asyncio.sleep(0.3)
    assert rig.faults.clear() == 1
    cleared = sensor.latest().stamp.seq
    async with asyncio.timeout(4.0):
        while sensor.latest().stamp.seq == cleared:
            await asyncio.sleep(0.005)


async def test_a_rig_without_the_instrument_refuses_its_faults(rig: LoopbackRig):
    bare = FaultBoard(rig.faults.truth, [Device.INK])
    with pytest.raises(ValueError, match="device = 'ink': this rig has none"):
        bare.hang(Fault(device=Device.INK, kind="garbage"))
