"""What is checked and set when an arm is enabled, and what keeps watch from then on."""

from __future__ import annotations

import asyncio
import dataclasses
import math
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from brushloop.drivers.arcs import stopping
from brushloop.drivers.arcs.controller import OutOfReach, QueueFull, RobotMode, SafetyMode, WrongOperationalMode
from brushloop.drivers.arcs.robot import ArcsOptions, AuboArcs
from brushloop.drivers.errors import MotionFailed, MotionRefused, RpcError
from brushloop.drivers.geometry import brush_pose, distance, from_wire, lean
from brushloop.drivers.host import HostClock
from brushloop.drivers.limits import Limits
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.kinematics import forward, pose_of
from brushloop.drivers.sim.rig import HOST
from tests.waiting import until

NEAR = brush_pose(260.0, -220.0, 250.0)
BEYOND = brush_pose(900.0, 0.0, 250.0)
BITES_S = 3.0
"""A watchdog's time-out that no pause of a busy machine reaches, and that a test can wait for."""
QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}
MakeArm = Callable[..., AuboArcs]


@pytest.fixture
def notices() -> list[str]:
    return []


@pytest.fixture
async def make_arm(cabinet: ArcsServer, limits: Limits, notices: list[str]) -> AsyncIterator[MakeArm]:
    """An arm that is not connected, by its options; its box is as wide as the room."""
    arms: list[AuboArcs] = []
    wide = dataclasses.replace(limits, x_mm=(-2000.0, 2000.0))

    def make(**options: Any) -> AuboArcs:
        whole = {"tcp_offset_mm": (0.0, 0.0, 180.0), **options}
        arms.append(AuboArcs(ArcsOptions(HOST, cabinet.port, **whole), wide, HostClock(), notices.append))
        return arms[-1]

    yield make
    for arm in arms:
        await arm.close()


async def enabled(make: MakeArm, **options: Any) -> AuboArcs:
    arm = make(**options)
    await arm.connect()
    await arm.enable()
    return arm


@pytest.mark.parametrize("mode", ["Manual", "Sideways", 7, None])
async def test_an_arm_that_is_not_on_automatic_is_neither_set_nor_powered(
    make_arm: MakeArm, cabinet: ArcsServer, mode: object
):
    cabinet._methods["rob1.RobotManage.getOperationalMode"] = lambda _: mode
    with pytest.raises(WrongOperationalMode, match="on the pendant") as caught:
        await enabled(make_arm)
    assert caught.value.mode == str(mode)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF
    assert cabinet.cabinet.tcp_offset == [0.0] * 6


async def test_a_cabinet_without_operational_modes_is_reported(
    make_arm: MakeArm, cabinet: ArcsServer, notices: list[str]
):
    cabinet.cabinet.operational_mode = "Disabled"
    await enabled(make_arm)
    del cabinet._methods["rob1.RobotManage.getOperationalMode"]
    await enabled(make_arm)
    assert [n for n in notices if "operational mode" in n] == notices
    assert len(notices) == 2


async def test_what_is_configured_is_set_in_the_wires_units(make_arm: MakeArm, cabinet: ArcsServer):
    options = {"payload_kg": 0.4, "payload_cog_mm": (0.0, 1.0, 60.0), "collision_level": 8, "speed_fraction": 0.5}
    await enabled(make_arm, **options)
    box = cabinet.cabinet
    assert box.payload == [0.4, [0.0, 0.001, 0.06], [0.0] * 3, [0.0] * 6]
    assert (box.collision_level, box.motion.fraction) == (8, 0.5)


async def test_a_brush_that_is_not_square_to_the_flange_is_pressed_upright(make_arm: MakeArm, cabinet: ArcsServer):
    turn = {"tcp_offset_mm": (4.0, -7.0, 180.0), "tcp_rotation_deg": (2.0, -1.5, 0.0)}
    arm = await enabled(make_arm, **turn)
    expected = [0.004, -0.007, 0.18, math.radians(2.0), math.radians(-1.5), 0.0]
    assert cabinet.cabinet.tcp_offset == pytest.approx(expected)
    await arm.move(NEAR, **QUICK)
    flange = from_wire(cabinet.cabinet.fk([*cabinet.cabinet.joints()])[0])
    assert distance(flange, NEAR)[0] < 0.1
    assert lean(pose_of(forward(cabinet.cabinet.joints())))[0] == pytest.approx(2.5, abs=0.05)


@pytest.mark.parametrize("wrong", [{"payload_kg": 9.0}, {"collision_level": 12}, {"speed_fraction": 1.5}])
async def test_what_the_controller_does_not_take_keeps_the_power_off(
    make_arm: MakeArm, cabinet: ArcsServer, wrong: dict[str, Any]
):
    with pytest.raises(MotionRefused):
        await enabled(make_arm, **wrong)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF


async def test_reduced_mode_is_allowed_and_reported_once(make_arm: MakeArm, cabinet: ArcsServer, notices: list[str]):
    arm = await enabled(make_arm)
    cabinet.cabinet.power.safety = SafetyMode.REDUCED
    await arm.move(NEAR, **QUICK)
    assert len(notices) == 1
    assert "ReducedMode" in notices[0]
    cabinet.cabinet.power.safety = SafetyMode.NORMAL
    await arm.move(brush_pose(265.0, -220.0, 250.0), **QUICK)
    assert len(notices) == 1


async def test_a_full_queue_is_an_error_of_its_own(make_arm: MakeArm, cabinet: ArcsServer):
    arm = await enabled(make_arm)
    cabinet._methods["rob1.MotionControl.moveLine"] = lambda _: 2
    with pytest.raises(QueueFull, match="Another client"):
        await arm.move(NEAR, **QUICK)


async def test_a_target_out_of_reach_names_the_controllers_message(make_arm: MakeArm, cabinet: ArcsServer):
    cabinet.cabinet.tell(30048)  # somebody else's, from before
    arm = await enabled(make_arm)
    with pytest.raises(OutOfReach, match="30047") as caught:
        await arm.move(BEYOND, **QUICK)
    assert caught.value.code == 30047
    assert isinstance(caught.value.__cause__, MotionFailed)
    await arm.move(NEAR, **QUICK)


@pytest.mark.parametrize("answer", [None, "no", [5, {}, {"code": "x", "timestamp": 1}, {"code": 30047}], {"a": 1}])
async def test_without_a_message_it_is_just_a_failed_motion(make_arm: MakeArm, cabinet: ArcsServer, answer: object):
    arm = await enabled(make_arm)
    cabinet._methods["rob1.Trace.peek"] = lambda _: answer
    with pytest.raises(MotionFailed) as caught:
        await arm.move(BEYOND, **QUICK)
    assert type(caught.value) is MotionFailed


def feeding() -> bool:
    return any(task.get_name() == "robot watchdog" for task in asyncio.all_tasks())


async def bitten(cabinet: ArcsServer) -> None:
    """Return once the watchdog has put the arm in a protective stop."""
    await until(lambda: not cabinet.cabinet.watchdogs, "the watchdog to bite")
    assert cabinet.cabinet.power.safety == SafetyMode.PROTECTIVE_STOP


async def test_the_watchdog_is_armed_while_enabled_and_fed(
    make_arm: MakeArm, cabinet: ArcsServer, notices: list[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(stopping, "FEEDINGS", 1000)
    arm = make_arm(watchdog_s=60.0)
    await arm.connect()
    assert cabinet.cabinet.watchdogs == {}
    await arm.enable()
    for feeding_number in range(1, 4):
        [(key, timer)] = cabinet.cabinet.watchdogs.items()
        assert key == "brushloop"
        await until(lambda timer=timer: cabinet.cabinet.watchdogs["brushloop"] is not timer, f"feed {feeding_number}")
    await arm.close()
    assert cabinet.cabinet.watchdogs == {}
    assert not feeding()
    assert cabinet.cabinet.power.safety == SafetyMode.NORMAL
    assert not notices


async def test_a_host_that_dies_leaves_a_protective_stop_and_no_motion(make_arm: MakeArm, cabinet: ArcsServer):
    arm = await enabled(make_arm, watchdog_s=BITES_S)
    await arm._motion.move_line(brush_pose(300.0, -220.0, 250.0), 0.1, 800.0)
    for controller in (arm._state, arm._motion, arm._stop):
        await controller.connection.close()
    arm._enabled = False  # who is dead does not say goodbye
    await bitten(cabinet)
    await until(lambda: cabinet.cabinet.motion.steady(cabinet.cabinet.now_s()), "the arm to rest")
    assert cabinet.cabinet.motion.exec_id(cabinet.cabinet.now_s()) != -1, "it rests on its way"


async def test_a_controller_that_knows_no_watchdog_is_reported_and_used(
    make_arm: MakeArm, cabinet: ArcsServer, notices: list[str]
):
    del cabinet._methods["RegisterControl.setWatchDog"]
    arm = await enabled(make_arm, watchdog_s=2.0)
    await arm.move(NEAR, **QUICK)
    assert len(notices) == 1
    assert "no watchdog" in notices[0]


async def test_an_arm_that_cannot_be_stopped_is_left_to_the_watchdog(make_arm: MakeArm, cabinet: ArcsServer):
    arm = await enabled(make_arm, watchdog_s=BITES_S)

    async def fails(_: float) -> None:
        raise MotionFailed("robot", "stop", "not seen at rest")

    arm._stopper.stop = fails  # type: ignore[method-assign]
    await arm.close()
    assert list(cabinet.cabinet.watchdogs) == ["brushloop"]
    await bitten(cabinet)


async def test_an_error_other_than_unknown_method_is_not_taken_for_an_old_controller(
    make_arm: MakeArm, cabinet: ArcsServer
):
    def broken(_: object) -> object:
        raise ValueError("broken")

    cabinet._methods["rob1.RobotManage.getOperationalMode"] = broken
    with pytest.raises(RpcError):
        await enabled(make_arm)
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF
