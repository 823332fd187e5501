"""What becomes of the pose when its stream fails: polling takes over, which is reported once.

What the bytes may be is in tests/drivers/arcs/test_rtde.py.
"""

from __future__ import annotations

import asyncio

import pytest

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import ArcsOptions
from brushloop.drivers.devices import PoseSample
from brushloop.drivers.errors import Stale
from brushloop.drivers.host import HostClock
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
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
