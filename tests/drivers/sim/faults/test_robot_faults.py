"""What the arm's driver does when the controller misbehaves: which error it names, and that the arm then rests."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from brushloop.drivers.arcs.controller import RobotMode, SafetyMode
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    MotionFailed,
    ProtocolViolation,
    RobotNotSafe,
)
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault
from brushloop.drivers.sim.rig import LoopbackRig

FAR = brush_pose(250.0, -30.0, 260.0)  # 200 mm from home
SLOW = {"speed_mm_s": 5.0, "acc_mm_s2": 800.0}  # two real seconds
QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}
POLL = "getSafetyModeType"  # what a move asks for while it waits, and telemetry does not


def robot(kind: str, **more: object) -> Fault:
    return Fault.model_validate({"device": Device.ROBOT, "kind": kind, **more})


def to_go_mm(cabinet: ArcsServer) -> float:
    return distance(cabinet.cabinet.world.tool(), FAR)[0]


def at_rest(cabinet: ArcsServer) -> bool:
    return cabinet.cabinet.motion.exec_id(cabinet.cabinet.now_s()) == -1


ENDS: list[tuple[str, type[DeviceError], str]] = [
    ("mute", DeviceTimeout, "no reply"),
    ("late", DeviceTimeout, "no reply"),
    ("wrong-id", DeviceTimeout, "no reply"),
    ("malformed", ProtocolViolation, "reply is not JSON"),
    ("garbage", ConnectionLost, "expected SOF"),
    ("drop", ConnectionLost, "closed the connection"),
]


@pytest.mark.parametrize("on", ["moveLine", POLL])
@pytest.mark.parametrize(("kind", "error", "words"), ENDS)
async def test_one_bad_reply_ends_the_move_with_its_name_and_the_arm_rests_on_its_way(
    arm: AuboArcs, cabinet: ArcsServer, kind: str, error: type[DeviceError], words: str, on: str
):
    more = {"late_s": 1.0} if kind == "late" else {}
    cabinet.faults.hang(robot(kind, on=on, nth=1 if on == "moveLine" else 5, **more))
    with pytest.raises(error, match=words) as caught:
        await arm.move(FAR, **SLOW)
    assert on in caught.value.op
    assert not getattr(caught.value, "__notes__", []), "the arm was seen at rest"
    assert at_rest(cabinet)
    left_mm = to_go_mm(cabinet)
    assert 50.0 < left_mm < 200.0
    await asyncio.sleep(0.7 if kind == "late" else 0.1)  # the late reply comes, and nothing comes of it
    assert to_go_mm(cabinet) == left_mm


async def test_a_line_that_never_arrives_is_a_timeout_and_nothing_has_moved(arm: AuboArcs, cabinet: ArcsServer):
    cabinet.faults.hang(robot("deaf", on="moveLine"))
    with pytest.raises(DeviceTimeout, match="moveLine"):
        await arm.move(FAR, **SLOW)
    assert to_go_mm(cabinet) == pytest.approx(200.0)


@pytest.mark.parametrize("kind", ["mute", "deaf"])
async def test_a_controller_that_falls_silent_is_reported_as_an_arm_that_may_still_move(
    arm: AuboArcs, cabinet: ArcsServer, kind: str
):
    """`mute` carries out the stop and cannot say so, `deaf` does not: from outside both look alike."""
    cabinet.faults.hang(robot(kind, phase="travelling", nth=5, count=ALWAYS))
    with pytest.raises(DeviceTimeout) as caught:
        await arm.move(FAR, **SLOW)
    [note] = caught.value.__notes__
    assert "The arm may still be moving. Use the emergency stop." in note
    if kind == "mute":
        assert at_rest(cabinet)
    with pytest.raises(MotionFailed, match="may still be moving"):
        await arm.close()


TOLERATED = [robot("split", count=ALWAYS), robot("duplicate", count=ALWAYS), robot("late", count=8, late_s=0.15)]


@pytest.mark.parametrize("fault", TOLERATED, ids=lambda fault: fault.kind)
async def test_replies_in_pieces_twice_or_a_little_late_change_nothing(
    arm: AuboArcs, cabinet: ArcsServer, fault: Fault
):
    cabinet.faults.hang(fault)
    await arm.move(FAR, **QUICK)
    assert to_go_mm(cabinet) <= 0.05
    await arm.stop()


@pytest.mark.parametrize(
    ("kind", "mode", "condition", "power"),
    [
        ("protective-stop", SafetyMode.PROTECTIVE_STOP, "brakes open", RobotMode.RUNNING),
        ("safeguard-stop", SafetyMode.SAFEGUARD_STOP, "brakes on", RobotMode.RUNNING),
        ("emergency-stop", SafetyMode.ROBOT_EMERGENCY_STOP, "no power", RobotMode.POWER_OFF),
    ],
)
async def test_a_safety_stop_in_mid_move_is_named_with_its_condition_and_stays_until_a_person_ends_it(
    rig: LoopbackRig,
    arm_at: Callable[[int], AuboArcs],
    kind: str,
    mode: SafetyMode,
    condition: str,
    power: RobotMode,
):
    arm = arm_at(rig.arcs.port)
    await arm.connect()
    await arm.enable()
    rig.faults.hang(robot(kind, phase="travelling"))  # begins by itself, once the arm has left
    with pytest.raises(RobotNotSafe) as caught:
        await arm.move(FAR, **SLOW)
    assert caught.value.mode == mode
    assert condition in caught.value.condition
    assert caught.value.remedy
    assert at_rest(rig.arcs)
    left_mm = to_go_mm(rig.arcs)
    assert 100.0 < left_mm < 200.0
    assert (rig.arcs.cabinet.power.safety, rig.arcs.cabinet.power.mode) == (mode, power)

    assert rig.arcs.cabinet.release() == mode
    assert rig.arcs.cabinet.power.safety == SafetyMode.NORMAL
    rig.arcs.cabinet.resume()  # whoever resumes finds no path: the driver's own stop has dropped it
    await asyncio.sleep(0.1)
    assert to_go_mm(rig.arcs) == left_mm
    await arm.enable()
    await arm.move(FAR, **QUICK)
    await arm.close()


async def test_a_stop_that_a_request_triggers_strikes_with_that_request(arm: AuboArcs, cabinet: ArcsServer):
    cabinet.faults.hang(robot("protective-stop", on="moveLine"))
    with pytest.raises(RobotNotSafe, match="ProtectiveStop"):
        await arm.move(FAR, **SLOW)
    assert to_go_mm(cabinet) > 150.0, "stopped at the beginning; 100 mm pass in a real second"
