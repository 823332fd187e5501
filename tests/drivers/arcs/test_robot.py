from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import pytest

from brushloop.drivers.arcs import robot as robot_module
from brushloop.drivers.arcs.controller import RobotMode, SafetyMode
from brushloop.drivers.arcs.motion import planned_s
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose, Robot
from brushloop.drivers.errors import (
    ConnectionLost,
    LimitExceeded,
    NotConnected,
    RobotNotSafe,
    RpcError,
    Stale,
    WrongGeneration,
)
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arcs_server import ArcsServer
from tests.drivers.failing import mute

NEAR = brush_pose(260.0, -220.0, 250.0)
QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}
SLOW = {"speed_mm_s": 5.0, "acc_mm_s2": 800.0}
ArmAt = Callable[[int], AuboArcs]


async def test_connecting_reports_who_answers_and_where_the_tool_is(cabinet: ArcsServer, arm_at: ArmAt):
    arm = arm_at(cabinet.port)
    assert isinstance(arm, Robot)
    with pytest.raises(NotConnected):
        arm.latest()
    identity = await arm.connect()
    assert identity.simulated
    assert identity.model.startswith("aubo_i5")
    # no tool is set yet: it speaks of the flange
    assert arm.latest().pose.position_mm == pytest.approx((250.0, -230.0, 260.0 + 180.0))
    await arm.close()


async def test_a_cabinet_of_another_make_is_not_taken_for_the_loopback_rig(cabinet: ArcsServer, arm_at: ArmAt):
    cabinet._methods["rob1.RobotConfig.getControlBoxType"] = lambda _: "cb_ISStation"
    arm = arm_at(cabinet.port)
    assert not (await arm.connect()).simulated
    await arm.close()


async def test_an_arm_that_was_not_enabled_is_not_moved(sleeping_arm: AuboArcs, cabinet: ArcsServer):
    with pytest.raises(NotConnected, match="not enabled"):
        await sleeping_arm.move(NEAR, **QUICK)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF


async def test_enabling_runs_the_arm_and_sets_the_tool_but_moves_nothing(sleeping_arm: AuboArcs, cabinet: ArcsServer):
    before = cabinet.cabinet.world.tool()
    await sleeping_arm.enable()
    await sleeping_arm.enable()
    assert cabinet.cabinet.power.mode == RobotMode.RUNNING
    assert cabinet.cabinet.tcp_offset == [0.0, 0.0, 0.18, 0.0, 0.0, 0.0]
    assert distance(before, cabinet.cabinet.world.tool())[0] == 0.0
    assert distance(before, sleeping_arm.latest().pose)[0] < 1e-6, "with the tool set, it speaks of the tip"


async def test_a_slow_turn_on_the_spot_is_given_the_time_it_takes(arm: AuboArcs):
    home = arm.latest().pose
    x, y, z = home.position_mm
    turn = brush_pose(x, y, z, heading_deg=90.0)
    planned = planned_s(home, turn, 20.0, 800.0)
    assert planned >= math.radians(90.0) / 0.020  # 20 mm/s is read as 0.02 rad/s
    await arm.move(turn, **QUICK)


BEYOND: list[tuple[str, Pose, dict[str, float]]] = [
    ("x", brush_pose(199.9, 0.0, 200.0), {}),
    ("y", brush_pose(400.0, 260.1, 200.0), {}),
    ("z", brush_pose(400.0, 0.0, 94.9), {}),
    ("z", brush_pose(400.0, 0.0, math.nan), {}),
    ("x", brush_pose(math.inf, 0.0, 200.0), {}),
    ("tilt", brush_pose(400.0, 0.0, 200.0, tilt_deg=15.1), {}),
    ("speed", NEAR, {"speed_mm_s": 250.1}),
    ("speed", NEAR, {"speed_mm_s": 0.0}),
    ("speed", NEAR, {"speed_mm_s": math.nan}),
    ("acceleration", NEAR, {"acc_mm_s2": 1000.1}),
    ("acceleration", NEAR, {"acc_mm_s2": math.nan}),
]


@pytest.mark.parametrize(("field", "target", "change"), BEYOND)
async def test_a_target_beyond_the_limits_is_refused_before_anything_is_sent(
    arm_at: ArmAt, field: str, target: Pose, change: dict[str, float]
):
    nowhere = arm_at(1)  # not connected: asking the controller anything would raise NotConnected
    with pytest.raises(LimitExceeded) as caught:
        await nowhere.move(target, **{**QUICK, **change})
    assert caught.value.field == field


async def test_a_protective_stop_names_condition_and_remedy_and_nothing_clears_it(arm: AuboArcs, cabinet: ArcsServer):
    move = asyncio.create_task(arm.move(brush_pose(350.0, -150.0, 250.0), **SLOW))
    await asyncio.sleep(0.2)
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe, match="ProtectiveStop") as caught:
        await move
    assert caught.value.mode == "ProtectiveStop"
    assert "brakes open" in caught.value.condition
    assert "on the pendant" in caught.value.remedy
    for attempt in (arm.move(NEAR, **QUICK), arm.enable()):
        with pytest.raises(RobotNotSafe):
            await attempt
    assert cabinet.cabinet.power.safety == SafetyMode.PROTECTIVE_STOP


@pytest.mark.parametrize("mode", ["ArmOnFire", 5, ["Normal"], None])
async def test_a_safety_mode_that_nobody_knows_forbids_motion(arm: AuboArcs, cabinet: ArcsServer, mode: object):
    cabinet._methods["rob1.RobotState.getSafetyModeType"] = lambda _: mode
    with pytest.raises(RobotNotSafe, match="Look at the pendant"):
        await arm.move(NEAR, **QUICK)


async def test_a_connection_that_drops_in_mid_move_ends_the_move_and_stops_the_arm(arm: AuboArcs, cabinet: ArcsServer):
    move = asyncio.create_task(arm.move(brush_pose(350.0, -150.0, 250.0), **SLOW))
    await asyncio.sleep(0.2)
    cabinet.drop_clients()
    with pytest.raises(ConnectionLost):
        await move
    await asyncio.sleep(0.1)
    assert cabinet.cabinet.world.motion.exec_id(cabinet.cabinet.now_s()) == -1


async def test_latest_goes_stale_when_the_controller_falls_silent(arm: AuboArcs, cabinet: ArcsServer):
    mute(cabinet)
    await asyncio.sleep(0.6)
    with pytest.raises(Stale) as caught:
        arm.latest()
    assert caught.value.age_ms > 500.0
    cabinet.faults.clear()
    async with asyncio.timeout(2.0):  # and is fresh again by itself
        while True:
            try:
                arm.latest()
                break
            except Stale:
                await asyncio.sleep(0.05)


async def test_a_cabinet_of_the_older_generation_is_named_as_such(
    arm_at: ArmAt, unused_tcp_port: int, monkeypatch: pytest.MonkeyPatch
):
    async with await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0) as older:
        monkeypatch.setattr(robot_module, "AUBOPE_PORT", older.sockets[0].getsockname()[1])
        with pytest.raises(WrongGeneration, match="AUBOPE"):
            await arm_at(unused_tcp_port).connect()


async def test_where_nothing_listens_the_connection_is_lost(
    arm_at: ArmAt, unused_tcp_port: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(robot_module, "AUBOPE_PORT", unused_tcp_port)
    with pytest.raises(ConnectionLost):
        await arm_at(unused_tcp_port).connect()


async def test_a_connect_that_fails_half_way_leaves_nothing_open(cabinet: ArcsServer, arm_at: ArmAt):
    del cabinet._methods["rob1.RobotConfig.getRobotType"]
    with pytest.raises(RpcError, match="-32601"):
        await arm_at(cabinet.port).connect()
    await asyncio.sleep(0.05)
    assert cabinet.clients == 0


async def test_a_method_that_the_controller_does_not_know_is_an_error_with_its_code(arm: AuboArcs, cabinet: ArcsServer):
    del cabinet._methods["rob1.MotionControl.moveLine"]
    with pytest.raises(RpcError) as caught:
        await arm.move(NEAR, **QUICK)
    assert caught.value.code == -32601


async def test_closing_twice_is_fine_and_later_calls_say_that_it_is_closed(arm: AuboArcs):
    await arm.close()
    await arm.close()
    with pytest.raises(NotConnected):
        await arm.move(NEAR, **QUICK)
    with pytest.raises(NotConnected):
        await arm.stop()
