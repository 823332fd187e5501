"""Once a press is released the controller carries it out, lift included: an answer that nobody can read is no reason to
stop the arm with the brush in the paper. A person's stop still is."""

from __future__ import annotations

import asyncio

import pytest

from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.devices import QueuedLine
from brushloop.drivers.errors import DeviceTimeout, MotionFailed, RobotNotSafe
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from tests.waiting import PATIENCE_S

TOP_Z_MM, DEEP_Z_MM = 300.0, 200.0
TOP, DEEP = brush_pose(250.0, -230.0, TOP_Z_MM), brush_pose(250.0, -230.0, DEEP_Z_MM)
PRESS = [QueuedLine(brush_pose(250.0, -230.0, 200.05), 40.0), QueuedLine(DEEP, 40.0, 4.0), QueuedLine(TOP, 40.0)]
ACC = 800.0


@pytest.fixture(autouse=True)
def impatient_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RpcConnection.__init__.__kwdefaults__, "timeout_s", 0.3)


def z_mm(cabinet: ArcsServer) -> float:
    return cabinet.cabinet.world.tool().z_mm


async def below(cabinet: ArcsServer, depth_mm: float) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while z_mm(cabinet) > depth_mm:
            await asyncio.sleep(0.002)


@pytest.mark.parametrize("kind", ["malformed", "garbage", "mute", "wrong-id", "drop"])
@pytest.mark.parametrize("method", ["getExecId", "getTcpPose", "getSafetyModeType"])
async def test_an_answer_that_cannot_be_read_in_a_descent_is_asked_again(
    arm: AuboArcs, cabinet: ArcsServer, kind: str, method: str
) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind=kind, on=method, count=2))
    await press
    _, deep, top = list(cabinet.cabinet.world.motion.rests)[-3:]
    assert (deep.pose.z_mm, top.pose.z_mm) == pytest.approx((DEEP_Z_MM, TOP_Z_MM))
    await arm.move(DEEP, speed_mm_s=100.0, acc_mm_s2=ACC)


@pytest.mark.parametrize("kind", ["malformed", "mute", "drop"])
async def test_a_release_whose_answer_cannot_be_read_is_carried_out(
    arm: AuboArcs, cabinet: ArcsServer, kind: str
) -> None:
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind=kind, on="startMove"))
    await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert z_mm(cabinet) == pytest.approx(TOP_Z_MM)


async def test_a_controller_that_never_answers_again_is_given_the_time_of_the_press(
    arm: AuboArcs, cabinet: ArcsServer
) -> None:
    quick = [QueuedLine(line.target, 250.0, 0.2 if line.least_s else 0.0) for line in PRESS]
    press = asyncio.create_task(arm.sequence(quick, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind="deaf", count=ALWAYS))
    with pytest.raises(DeviceTimeout):
        await press
    assert z_mm(cabinet) == pytest.approx(TOP_Z_MM)
    cabinet.faults.clear()


async def test_a_stop_is_carried_out_at_once_although_no_answer_can_be_read(arm: AuboArcs, cabinet: ArcsServer) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.faults.hang(Fault(device=Device.ROBOT, kind="malformed", on="getSafetyModeType", count=ALWAYS))
    await arm.stop()
    assert z_mm(cabinet) > DEEP_Z_MM
    assert cabinet.cabinet.world.motion.size == 0
    cabinet.faults.clear()
    with pytest.raises(MotionFailed):
        await press


async def test_a_safety_stop_that_can_be_read_ends_the_press_at_once(arm: AuboArcs, cabinet: ArcsServer) -> None:
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    await below(cabinet, 255.0)
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe):
        await press
    assert DEEP_Z_MM < z_mm(cabinet) < TOP_Z_MM
