"""The doctor: what answers, what is wrong, how to put it right; and the archive that it writes."""

from __future__ import annotations

import asyncio
import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from brushloop.collect.commission.visit import Notebook, Taught
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.doctor import examine, scrubber_of
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.faults import Device, Fault
from brushloop.drivers.sim.rig import rig_toml
from tests.command import brushloop
from tests.drivers.arcs.transcript import Archive

if TYPE_CHECKING:
    from tests.rigs import Lab


@pytest.fixture
def lab(wired_lab: Lab) -> Lab:
    return wired_lab


async def test_whatever_is_wrong_is_reported_with_a_remedy_and_every_other_device_is_still_asked(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brushloop.drivers.force.sri_m8123.CONNECT_S", 2.0)
    lab.rig.faults.hang(Fault(device=Device.INK, kind="deaf", count=100))
    lab.rig.faults.hang(Fault(device=Device.FORCE, kind="no-second", count=10_000))
    lab.edit_rig("DICT_5X5_1000", "DICT_4X4_1000")
    lab.rig.arcs.cabinet.safety_stop()
    findings = await examine(load_rig(lab.folder / "rig.toml"), HostClock())
    assert not any(finding.well for finding in findings)
    problems = ("board corners found", "no whole round", "no reply", "ProtectiveStop")
    remedies = ("into view", "wiring", "", "pendant")
    for finding, answers, problem, remedy in zip(findings, (True, False, False, True), problems, remedies, strict=True):
        assert finding.answers is answers
        assert problem in finding.problem
        assert finding.remedy
        assert remedy in finding.remedy
    assert lab.rig.arcs.cabinet.power.safety == SafetyMode.PROTECTIVE_STOP, "not cleared"

    lab.rig.faults.clear()
    lab.edit_rig(f"port = {lab.rig.arcs.port}\n", "port = 9\n")
    ran = await asyncio.to_thread(brushloop, "doctor", "--config", lab.folder / "rig.toml")
    assert (ran.returncode, ran.stderr) == (4, "")
    for words in ("no answer", "127.0.0.1:9", "ink-station"):
        assert words in ran.stdout


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(SimConfig(), ink_path="/dev/serial/by-id/usb-lab-7", ports={"arcs": 9, "rtde": 9}))
    return path


def test_a_rig_in_order_is_reported_with_all_that_was_answered_and_left_as_it_was(lab: Lab) -> None:
    report = lab.folder / "report.zip"
    ran = brushloop("doctor", "--config", lab.folder / "rig.toml", "--report", report)
    assert ran.returncode == 0
    assert "Read it before you send it" in ran.stdout
    with zipfile.ZipFile(report) as archive:
        document = json.loads(archive.read("report.json"))
        rtde = json.loads(archive.read("rtde.json"))
    camera, force, ink, robot = document["findings"]
    assert all(finding["well"] for finding in document["findings"])
    assert robot["identity"] == "aubo_i5 (brushloop-loopback)"
    assert robot["latency_ms"] > 0.0
    assert "PowerOff, safety Normal, simulated" in robot["notes"]
    assert camera["notes"].startswith("board: ")
    assert "rounds/s" in force["notes"]
    assert [ink[name] for name in ("identity", "firmware", "notes")] == [
        "ink-station",
        "1.0.0",
        "well 71% full, simulated",
    ]
    assert document["versions"]["brushloop"]
    assert document["versions"]["numpy"]
    assert document["platform"]["python"]
    sent = document["rig"]
    assert sent["robot"]["host"] == sent["brush"]["name"] == sent["camera"]["source"] == "<text>"
    assert sent["robot"]["kind"] == "aubo-arcs"
    assert sent["robot"]["tcp_offset_mm"] == [0.0, 0.0, 180.0]
    assert sent["board"]["squares"] == [26, 20]
    assert "127.0.0.1" not in json.dumps(document)
    assert len(rtde["sample"]) == 2
    lines = Archive(report).lines
    answered = {line["method"]: line["answer"] for line in lines}
    assert answered["rob1.RobotState.getSafetyModeType"] == {"result": "Normal"}
    assert answered["rob1.MotionControl.getSpeedFraction"]["result"] == 1.0
    assert all(line["took_ms"] > 0.0 for line in lines)
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"
    assert lab.rig.world.motion._next_id == 0


def test_names_addresses_and_paths_stay_in_the_lab(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRUSHLOOP_ROBOT__HOST", "arm7.lab.example")
    monkeypatch.setenv("LOGNAME", "wanghui")
    monkeypatch.setattr("socket.gethostname", lambda: "rigpc")
    scrubber = scrubber_of(load_rig(rig).model_dump(mode="json"))
    said = (
        "robot: connect: arm7.lab.example:30004 as wanghui@rigpc from 192.0.2.7 (fe80::1:2:3, 00:1b:44:11:3a:b7); "
        "see /home/wanghui/rig.toml and C:\\Users\\wanghui, http://wanghui:secret@cam.example/stream, "
        "on rigpc; 200 rounds/s, 0.1600 mm/px"
    )
    scrubbed = scrubber.text(said)
    for secret in ("arm7", "lab.example", "wanghui", "rigpc", "192.0.2.7", "fe80", "00:1b", "secret", "cam.example"):
        assert secret not in scrubbed, scrubbed
    assert scrubbed.startswith("robot: connect: <host>:30004 as ")
    assert scrubbed.endswith("on <host>; 200 rounds/s, 0.1600 mm/px")


def test_an_archive_is_never_overwritten(rig: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.zip"
    report.write_bytes(b"mine")
    ran = brushloop("doctor", "--config", rig, "--report", report)
    assert (ran.returncode, report.read_bytes()) == (2, b"mine")
    assert "is not overwritten" in ran.stderr


def test_on_the_first_day_there_is_no_rig_yet_and_the_archive_holds_what_is_known(lab: Lab) -> None:
    robot = load_rig(lab.folder / "rig.toml").robot
    rig, report = lab.folder / "new.toml", lab.folder / "report.zip"
    address = Taught(f"{robot.host}:{robot.port}", "typed")
    stream = Taught("http://cam.example/stream", "typed")
    squares = Taught([26.0, 20.0], "typed")
    values = {"aside.address": address, "camera.source": stream, "board.squares": squares}
    Notebook().with_values(values).save(rig)
    ran = brushloop("doctor", "--config", rig, "--report", report)
    assert ran.returncode == 0, ran.stderr
    assert "new.toml yet" in ran.stdout
    archive = Archive(report)
    answered = {line["method"]: line["answer"] for line in archive.lines}
    assert answered["rob1.RobotState.getSafetyModeType"] == {"result": "Normal"}
    with zipfile.ZipFile(report) as held:
        text = held.read("report.json").decode()
    assert json.loads(text)["rig"]["board.squares"] == [26, 20]
    assert robot.host not in text
    assert "cam.example" not in text
