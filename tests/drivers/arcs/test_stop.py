"""Stop: from any state, never queued behind anything, and after every move that does not end well."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from brushloop.drivers.arcs import stopping
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, MotionError
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arcs_server import ArcsServer
from tests.drivers.failing import mute, mute_to

FAR = brush_pose(250.0, -30.0, 260.0)  # 200 mm from home: two seconds of the fast clock
SLOW = {"speed_mm_s": 5.0, "acc_mm_s2": 800.0}


@pytest.fixture
async def move(arm: AuboArcs) -> AsyncIterator[asyncio.Task[None]]:
    """A slow move that is under way."""
    task = asyncio.create_task(arm.move(FAR, **SLOW))
    await asyncio.sleep(0.2)
    yield task
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def to_go_mm(cabinet: ArcsServer) -> float:
    return distance(cabinet.cabinet.world.tool(), FAR)[0]


async def comes_to_rest(cabinet: ArcsServer) -> bool:
    """Within 0.1 s the arm rests, far from its target and not back at its start."""
    await asyncio.sleep(0.1)
    at_rest = cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1
    return at_rest and 100.0 < to_go_mm(cabinet) < 199.0


async def test_a_stop_in_mid_move_stops_the_arm_well_short_and_the_move_fails(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None]
):
    await arm.stop()
    assert await comes_to_rest(cabinet)
    with pytest.raises(MotionError, match="from the target"):
        await move


async def test_a_second_stop_in_mid_move_changes_nothing(arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None]):
    await arm.stop()
    await arm.stop()
    assert await comes_to_rest(cabinet)


async def test_a_stop_is_fine_in_a_protective_stop(arm: AuboArcs, cabinet: ArcsServer):
    cabinet.cabinet.safety_stop()
    await arm.stop()


async def test_a_move_after_a_stop_starts_where_the_arm_came_to_rest(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None]
):
    await arm.stop()
    x, y, z = cabinet.cabinet.world.tool().position_mm
    step = brush_pose(x, y + 1.5, z)
    await arm.move(step, speed_mm_s=100.0, acc_mm_s2=800.0)
    assert distance(cabinet.cabinet.world.tool(), step)[0] < 0.05


@pytest.mark.parametrize("silent", ["MotionControl.getExecId", "RobotState.getSafetyModeType"])
async def test_a_stop_does_not_wait_behind_a_command_that_hangs(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None], silent: str
):
    mute_to(cabinet, f"rob1.{silent}")
    await asyncio.sleep(0.1)  # the move now waits for an answer that does not come
    pressed = asyncio.create_task(arm.stop())
    await asyncio.sleep(0.2)
    assert await comes_to_rest(cabinet)
    assert not move.done()
    await pressed  # it returns once rest has been seen, whatever is muted


async def test_a_move_whose_answer_is_lost_stops_the_arm(arm: AuboArcs, cabinet: ArcsServer):
    mute_to(cabinet, "rob1.MotionControl.moveLine")
    with pytest.raises(DeviceTimeout, match="moveLine"):
        await arm.move(FAR, **SLOW)
    assert cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1
    assert to_go_mm(cabinet) > 50.0


async def test_a_stop_gets_through_after_its_connection_was_dropped(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None]
):
    cabinet.drop_clients()
    await asyncio.sleep(0)
    await arm.stop()
    assert await comes_to_rest(cabinet)


async def test_nothing_moves_while_there_is_no_way_to_stop_it(arm: AuboArcs, cabinet: ArcsServer):
    await cabinet.stop()
    with pytest.raises(ConnectionLost):
        await arm.move(FAR, **SLOW)
    assert to_go_mm(cabinet) == pytest.approx(200.0)


async def test_a_move_that_could_not_be_stopped_says_so(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(stopping, "CONFIRM_S", 1.0)
    mute(cabinet)
    with pytest.raises(DeviceTimeout) as caught:
        await move
    assert "may still be moving" in caught.value.__notes__[0]
    cabinet.faults.clear()


async def test_a_stop_gets_through_while_its_own_connection_is_silently_dead(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None], monkeypatch: pytest.MonkeyPatch
):
    async def nothing(*_: object) -> None:
        await asyncio.sleep(1.0)
        raise DeviceTimeout("robot", "stopLine", "no reply in 1 s")

    monkeypatch.setattr(arm._stop.connection, "call", nothing)
    pressed = asyncio.create_task(arm.stop())
    await asyncio.sleep(0.4)
    assert await comes_to_rest(cabinet)
    await pressed


async def test_a_line_that_was_still_on_its_way_is_stopped_too(
    arm: AuboArcs, cabinet: ArcsServer, monkeypatch: pytest.MonkeyPatch
):
    send = arm._motion.connection.call

    async def late(method: str, params: object = None) -> object:
        if method.endswith("moveLine"):
            asyncio.get_running_loop().call_later(0.25, lambda: asyncio.ensure_future(send(method, params)))
            raise DeviceTimeout("robot", "moveLine", "no reply in 1 s")
        return await send(method, params)

    monkeypatch.setattr(stopping, "RESTS_NEEDED", 20)  # the line comes within the time that rest is asked for
    monkeypatch.setattr(arm._motion.connection, "call", late)
    with pytest.raises(DeviceTimeout):
        await arm.move(FAR, **SLOW)
    assert cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1
    assert to_go_mm(cabinet) > 100.0


async def test_a_line_left_in_the_queue_by_a_dead_process_is_stopped_before_anything_is_set(
    sleeping_arm: AuboArcs, cabinet: ArcsServer
):
    await sleeping_arm.enable()
    cabinet.cabinet.world.motion.add(FAR, 5.0, 800.0, cabinet.cabinet.now_s())
    await sleeping_arm.enable()
    assert cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1
    assert to_go_mm(cabinet) > 100.0


class SlowNetwork:
    """A connection's writer behind a network that delivers everything 0.25 s later, in order."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer

    def write(self, data: bytes) -> None:
        asyncio.get_running_loop().call_later(0.25, self._writer.write, data)

    def __getattr__(self, name: str) -> object:
        return getattr(self._writer, name)


async def test_a_stop_waits_for_a_line_that_is_on_its_way(
    arm: AuboArcs, cabinet: ArcsServer, monkeypatch: pytest.MonkeyPatch
):
    connection, sent = arm._motion.connection, asyncio.Event()
    send = connection.call

    async def delayed(method: str, params: object = None) -> object:
        if method.endswith("moveLine"):
            monkeypatch.setattr(connection, "_writer", SlowNetwork(connection._writer))
            sent.set()
        return await send(method, params)

    monkeypatch.setattr(connection, "call", delayed)
    move = asyncio.create_task(arm.move(FAR, **SLOW))
    await sent.wait()
    await arm.stop()  # overtakes the line
    stopped_mm = to_go_mm(cabinet)
    with pytest.raises(MotionError):
        await move
    assert to_go_mm(cabinet) == pytest.approx(stopped_mm)
    assert stopped_mm > 100.0


async def test_closing_goes_on_although_it_is_cancelled_and_says_that_the_arm_may_still_be_moving(
    arm: AuboArcs, cabinet: ArcsServer, move: asyncio.Task[None], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(stopping, "CONFIRM_S", 0.5)
    mute(cabinet)
    closing = asyncio.create_task(arm.close())
    for _ in range(2):
        await asyncio.sleep(0.1)
        closing.cancel()
    with pytest.raises(MotionError, match="may still be moving"):
        await closing
    cabinet.faults.clear()
