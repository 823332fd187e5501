"""Power and safety: what takes time on the simulated clock, and what only a person brings back."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs.cabinet import BOOT_S, BRAKE_RELEASE_S, POWER_OFF_S, POWER_ON_S
from brushloop.drivers.sim.world import SimClock

NEAR = brush_pose(350.0, -230.0, 260.0)
E_STOPS = [SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP]


def test_every_transition_takes_its_time(off: Any):
    off.ask("RobotManage.poweron")
    begun = (("Booting", 0.0), ("PowerOn", BOOT_S), ("Idle", POWER_ON_S))
    for (mode, from_s), (_, until_s) in itertools.pairwise((*begun, ("", 2.0 * POWER_ON_S))):
        for off.clock.s in (from_s, until_s - 1e-3):
            assert off.mode == mode
    off.clock.s = POWER_ON_S
    assert off.ask("RobotState.getJointState") == ["Idle"] * 6
    begun_s = off.clock.s
    off.ask("RobotManage.startup")
    off.clock.s = begun_s + BRAKE_RELEASE_S - 1e-3
    assert (off.mode, off.line(NEAR)) == ("BrakeReleasing", -1)
    off.clock.s = begun_s + BRAKE_RELEASE_S
    assert (off.mode, off.line(NEAR)) == ("Running", 0)
    off.ask("RobotManage.poweroff")
    assert off.mode == "PowerOffing"
    off.clock.s += POWER_OFF_S
    assert off.mode == "PowerOff"


def test_the_delays_are_those_of_the_simulated_clock(off: Any):
    clock = SimClock(rate=200.0)
    off.world.clock = clock
    asked_s = clock.now_s()
    off.ask("RobotManage.poweron")
    while off.mode != "Idle":
        pass
    assert clock.now_s() - asked_s >= POWER_ON_S
    assert clock.now_s() - asked_s < 100.0 * POWER_ON_S


@pytest.mark.parametrize("mode", E_STOPS)
def test_an_emergency_stop_takes_the_power_however_it_is_scripted(on: Any, mode: SafetyMode):
    on.line(NEAR)
    on.clock.s += 0.5
    on.cabinet.safety_stop(mode)
    assert (on.safety, on.mode, on.cabinet.power.button_down) == (mode.value, "PowerOff", True)
    on.clock.s += 5.0
    assert on.exec_id == -1
    assert 10.0 < on.off_mm(NEAR) < 90.0


def test_nothing_less_takes_the_place_of_an_emergency_stop(on: Any):
    on.cabinet.emergency_stop()
    for mode in (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP):
        on.cabinet.safety_stop(mode)
        assert on.safety == "RobotEmergencyStop"
    on.cabinet.power.reduce(True)
    on.cabinet.power.reset_safeguard()
    assert on.safety == "RobotEmergencyStop"


@pytest.mark.parametrize("asked", ["RobotManage.restartInterfaceBoard", "RobotManage.poweron", "RobotManage.startup"])
def test_no_method_brings_an_arm_back_while_the_button_is_down(on: Any, asked: str):
    on.cabinet.emergency_stop()
    for method in (asked, "RobotManage.setUnlockProtectiveStop", "RuntimeMachine.resume"):
        assert on.ask(method) != 0
        on.clock.s += 5.0
    assert (on.safety, on.mode) == ("RobotEmergencyStop", "PowerOff")
    on.cabinet.power.release_emergency_stop()
    on.clock.s += 5.0
    assert on.safety == "RobotEmergencyStop", "releasing the button alone brings nothing back"
    assert on.ask("RobotManage.restartInterfaceBoard") == 0
    on.run()
    assert (on.mode, on.line(NEAR)) == ("Running", 0)


def test_a_safeguard_is_reset_by_a_person_and_the_path_is_gone(on: Any):
    on.line(NEAR)
    on.clock.s += 0.5
    on.cabinet.safety_stop(SafetyMode.SAFEGUARD_STOP)
    assert on.ask("RobotState.isPowerOn") is True
    for method in ("RobotManage.setUnlockProtectiveStop", "RuntimeMachine.resume", "RobotManage.restartInterfaceBoard"):
        assert on.ask(method) == 1
    on.cabinet.power.reset_safeguard()
    on.clock.s += 5.0
    assert (on.safety, on.exec_id) == ("Normal", -1)
    assert on.off_mm(NEAR) > 10.0
    assert on.line(NEAR) == 0


def test_reduced_mode_comes_and_goes_with_its_input_and_moves_are_slow_meanwhile(on: Any):
    on.cabinet.power.reduce(True)
    assert on.safety == "ReducedMode"
    on.line(brush_pose(600.0, -230.0, 260.0), v=1.0)
    on.clock.s += 0.8
    assert on.speed_m_s() == pytest.approx(0.25)
    on.clock.s += 10.0
    on.cabinet.power.reduce(False)
    assert on.safety == "Normal"
    on.line(NEAR, v=1.0)
    on.clock.s += 0.48
    assert on.speed_m_s() > 0.4


def test_manual_operation_is_as_slow_as_reduced_mode(on: Any):
    on.ask("RobotManage.setOperationalMode", mode="Manual")
    on.line(brush_pose(600.0, -230.0, 260.0), v=1.0)
    on.clock.s += 0.8
    assert on.speed_m_s() == pytest.approx(0.25)
