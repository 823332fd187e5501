"""What the loopback controller knows better than any client, in either framing: its own truth, and faults on a script.

What every arm promises is in tests/contract, which can be held against hardware too.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator, Callable

import pytest

from brushloop.drivers.arcs.controller import RobotMode
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.wire import Framing
from brushloop.drivers.errors import ConnectionLost, NotPowered, RobotNotSafe, RpcError
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs.server import ArcsServer

NEAR = brush_pose(260.0, -220.0, 250.0)
FAR = brush_pose(250.0, -30.0, 260.0)
QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}
SLOW = {"speed_mm_s": 5.0, "acc_mm_s2": 800.0}


@pytest.fixture(params=["sof", "bare"])
def framing(request: pytest.FixtureRequest) -> Framing:
    return request.param


@pytest.fixture
async def sleeping_arm(
    cabinet: ArcsServer, arm_at: Callable[[int], AuboArcs], framing: Framing
) -> AsyncIterator[AuboArcs]:
    """Connected in that framing, powered off."""
    options = dataclasses.replace(arm_at(cabinet.port)._options, framing=framing)
    arm = AuboArcs(options, arm_at(cabinet.port)._limits, HostClock())
    assert (await arm.connect()).simulated
    yield arm
    await arm.close()


async def test_enabling_runs_the_arm_and_moves_nothing(sleeping_arm: AuboArcs, cabinet: ArcsServer):
    await sleeping_arm.enable()
    assert cabinet.cabinet.power.mode == RobotMode.RUNNING
    assert cabinet.cabinet.tcp_offset == [0.0, 0.0, 0.18, 0.0, 0.0, 0.0]
    assert distance(cabinet.cabinet.world.tool(), brush_pose(250.0, -230.0, 260.0))[0] < 1e-6


async def test_a_move_arrives_and_the_same_again_is_done(arm: AuboArcs, cabinet: ArcsServer):
    target = brush_pose(300.0, -200.0, 240.0, heading_deg=40.0, tilt_deg=10.0)
    for _ in range(2):
        await arm.move(target, **QUICK)
        off_mm, off_deg = distance(cabinet.cabinet.world.tool(), target)
        assert off_mm <= 0.05
        assert off_deg <= 0.1


async def test_an_arm_whose_power_went_refuses(arm: AuboArcs, cabinet: ArcsServer):
    cabinet.cabinet.power_off()
    with pytest.raises(NotPowered):
        await arm.move(NEAR, **QUICK)
    assert cabinet.cabinet.power.mode != RobotMode.RUNNING


async def test_a_protective_stop_in_mid_move_ends_it_and_the_path_is_dropped(arm: AuboArcs, cabinet: ArcsServer):
    move = asyncio.create_task(arm.move(FAR, **SLOW))
    await asyncio.sleep(0.2)
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe, match="ProtectiveStop"):
        await move
    assert cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1, (
        "nothing goes on when a person unlocks the arm"
    )


async def test_an_unknown_method_is_an_error_with_its_code(arm: AuboArcs, cabinet: ArcsServer):
    del cabinet._methods["rob1.MotionControl.moveLine"]
    with pytest.raises(RpcError) as caught:
        await arm.move(NEAR, **QUICK)
    assert caught.value.code == -32601


async def test_a_connection_that_drops_in_mid_move_ends_the_move(arm: AuboArcs, cabinet: ArcsServer):
    move = asyncio.create_task(arm.move(FAR, **SLOW))
    await asyncio.sleep(0.2)
    cabinet.drop_clients()
    with pytest.raises(ConnectionLost):
        await move
    await asyncio.sleep(0.1)
    assert cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1
