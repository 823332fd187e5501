"""The doctor: what answers, what is wrong, how to put it right; and nothing is powered by asking."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.doctor import examine
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.faults import Device, Fault
from tests.command import brushloop

if TYPE_CHECKING:
    from conftest import Lab


async def test_a_rig_in_order_is_reported_as_it_is_and_left_as_it_was(lab: Lab) -> None:
    camera, force, ink, robot = await examine(load_rig(lab.folder / "rig.toml"), HostClock())
    assert robot.well
    assert robot.identity == "aubo_i5 (brushloop-loopback)"
    assert robot.latency_ms is not None
    assert robot.latency_ms < 1000.0
    assert "PowerOff, safety Normal, simulated" in robot.notes
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"
    assert camera.well
    assert camera.notes.startswith("board: ")
    assert "ended" not in camera.notes
    assert force.well
    assert "rounds/s" in force.notes
    assert force.notes.endswith("N before bias, simulated")
    assert ink.well
    assert (ink.identity, ink.firmware) == ("ink-station", "1.0.0")
    assert ink.notes == "well 71% full, simulated"


async def test_an_instrument_that_was_unplugged_is_reported_and_the_others_are_still_asked(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brushloop.collect.rig.devices.FORCE_CONNECT_S", 2.0)
    lab.rig.faults.hang(Fault(device=Device.INK, kind="deaf", count=100))
    lab.rig.faults.hang(Fault(device=Device.FORCE, kind="no-second", count=10_000))
    camera, force, ink, robot = await examine(load_rig(lab.folder / "rig.toml"), HostClock())
    assert camera.well
    assert robot.well
    assert not ink.answers
    assert "no reply" in ink.problem
    assert ink.remedy
    assert not force.answers
    assert "no whole round" in force.problem
    assert "wiring" in force.remedy


async def test_a_board_that_cannot_be_seen_is_a_problem_with_a_remedy(lab: Lab) -> None:
    path = lab.folder / "rig.toml"
    path.write_text(path.read_text().replace("DICT_5X5_1000", "DICT_4X4_1000"))
    camera, *_ = await examine(load_rig(path), HostClock())
    assert camera.answers
    assert not camera.well
    assert "board corners found" in camera.problem
    assert "into view" in camera.remedy


async def test_a_protective_stop_is_reported_and_not_cleared(lab: Lab) -> None:
    lab.rig.arcs.cabinet.safety_stop()
    *_, robot = await examine(load_rig(lab.folder / "rig.toml"), HostClock())
    assert robot.answers
    assert not robot.well
    assert "ProtectiveStop" in robot.problem
    assert lab.rig.arcs.cabinet.power.safety == SafetyMode.PROTECTIVE_STOP


@pytest.mark.parametrize("flag", [(), ("--json",)])
def test_a_cabinet_that_does_not_answer_ends_with_code_4_and_the_rest_is_reported(
    lab: Lab, flag: tuple[str, ...]
) -> None:
    path = lab.folder / "rig.toml"
    path.write_text(path.read_text().replace(f"port = {lab.rig.arcs.port}\n", "port = 9\n"))
    ran = brushloop("doctor", "--config", path, *flag)
    assert ran.returncode == 4
    assert "Traceback" not in ran.stderr
    if flag:
        camera, _, _, robot = (json.loads(line) for line in ran.stdout.splitlines())
        assert camera["answers"]
        assert not robot["answers"]
        assert "127.0.0.1:9" in robot["problem"]
        assert robot["remedy"]
    else:
        assert "no answer" in ran.stdout
