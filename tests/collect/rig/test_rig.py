"""A rig.toml that cannot be used is one line; what it says is shown, and what in it cannot be true is named. And the
doctor: what answers, what is wrong, how to put it right; and the archive that it writes."""

from __future__ import annotations

import asyncio
import json
import re
import zipfile
from pathlib import Path

import pytest

from brushloop.collect.commission.visit import Notebook, Taught
from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.check import check_rig, places_of
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.doctor import Scrubber, examine
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.host import Clock
from brushloop.drivers.sim.faults import Device, Fault
from tests.collect.conftest import RIG
from tests.command import brushloop, refused, said
from tests.drivers.arcs.test_connections import Replayed
from tests.rigs import WASH, WIPE, Lab


def rig_file(tmp_path: Path, old: str = "", new: str = "") -> Path:
    assert old in RIG
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace(old, new) if old else RIG)
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("port = 30004", "port = 70000", r"rig.toml: robot.port: .*65535.*given: 70000"),
        ("[brush]", "[bursh]", r"rig.toml: bursh: unknown field; did you mean brush\?; errors besides this one: 1$"),
        ('kind = "ink-station"\n', "", r"ink.device.kind: is missing: one of 'ink-station', 'modbus-pump'$"),
        ("touch_z_mm = 120.030", "touch_z_mm = nan", r"paper.touch_z_mm: .*finite"),
        ("touch_point_mm = [2.0,", "touch_point_mm = [-2.0,", r"paper.touch_point_mm: \[-2, 2\] does not lie on the"),
        ("x_mm = [200.0, 640.0]", "x_mm = [640.0, 200.0]", r"robot.limits: .*x_mm = \[640.0, 200.0\]"),
        ("[robot]", "[robot", r"is not TOML"),
        ("port = 30004", f"port = {'9' * 10_000}", r"is not TOML"),
        ("stale_ms = 100.0", "stale_ms = 3000.0", r"force: stale_ms = 3000: must be from 20 to 2000;"),
        ("[motion]", '[touch]\nmethod = "camera"\npoints_mm = [[4.0, 4.0]]\n[motion]', r"touch: .*by camera needs"),
        ("[motion]", "[quality]\ndark_level = 200.0\nbright_level = 150.0\n[motion]", r"quality: .*dark_level"),
        ("[motion]", WIPE.replace("322.0", "120.0") + "[motion]", r"ink.wipe.rim_mm = .* lies on the sheet"),
        ("[motion]", WIPE.replace("130.0", "250.0") + "[motion]", r"ink.wipe.z_mm = 250 must lie in"),
        ("[motion]", WASH.replace("305.0", "100.0") + "[motion]", r"ink.wash.pot_mm = .* lies on the sheet"),
    ],
)
def test_a_bad_rig_is_refused_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_rig(rig_file(tmp_path, old, new))
    assert "\n" not in str(caught.value) or "TOML" in message


def test_a_real_sensor_is_never_waited_for_longer_than_a_tenth_of_a_second(tmp_path: Path) -> None:
    path = rig_file(tmp_path, 'channel = "loopback-force-board"', 'channel = "can0"')
    assert load_rig(path).force is not None
    path.write_text(path.read_text().replace("stale_ms = 100.0", "stale_ms = 100.1"))
    with pytest.raises(ConfigError, match=r"rig.toml: force: .*stale_ms = 100.1: must be from 20 to 100;"):
        load_rig(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("ROBOT__PORT", "abc", r"^environment variable BRUSHLOOP_ROBOT__PORT: robot.port: .*integer.*given: 'abc'"),
        ("INK__DEVICE__KIND", "x", r"^environment variable BRUSHLOOP_INK__DEVICE__KIND: ink.device.kind: 'x' is not"),
        ("PAPER", "[" * 100_000, r"environment variable BRUSHLOOP_PAPER: paper: is not JSON"),
        ("ROBOT__PROT", "5", r"^environment variable BRUSHLOOP_ROBOT__PROT: robot.prot: .*did you mean port\?"),
        ("XYZZY", "5", r"BRUSHLOOP_XYZZY: xyzzy: unknown field; known are name, robot, "),
        (
            "PAPER__TOUCH_Z_MM",
            "500",
            r"rig.toml: motion.safe_z_mm = .*; the environment sets BRUSHLOOP_PAPER__TOUCH_Z_MM",
        ),
    ],
)
def test_a_value_from_the_environment_is_refused_by_its_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str, message: str
) -> None:
    # Another one that is in order is not blamed.
    monkeypatch.setenv("BRUSHLOOP_ROBOT__HOST", "192.0.2.7")
    monkeypatch.setenv(f"BRUSHLOOP_{name}", value)
    with pytest.raises(ConfigError, match=message) as caught:
        load_rig(rig_file(tmp_path))
    assert "ROBOT__HOST" not in str(caught.value)


# What is shown of a rig.toml, and what in it cannot be true


def test_the_loopback_rig_contradicts_nothing_a_contradiction_ends_with_code_5_and_an_unusable_file_with_code_2(
    rig_path: Path,
) -> None:
    words = said("rig", "check", rig_path)
    assert "plausible tool length" in words
    assert "not measured lens not calibrated" in words
    assert words.endswith("10 values are plausible, 0 contradict others, 7 were not measured")
    assert (
        brushloop("rig", "check", rig_file(rig_path.parent, "max_depth_mm = 22.0", "max_depth_mm = 47.0")).returncode
        == 5
    )
    why = refused("rig", "check", rig_file(rig_path.parent, "safe_z_mm = 180.0", "safe_z_mm = 18.0"))
    assert "motion.safe_z_mm = 18 is below" in why


@pytest.mark.parametrize(
    ("old", "new", "name", "remedy"),
    [
        ("[0.0, 0.0, 180.0]", "[0.0, 0.0, 0.18]", "tool length", "0.18 m are 180 mm"),
        ("square_mm = 12.0\nmarker_mm = 9.0", "square_mm = 0.012\nmarker_mm = 0.009", "square of the board", "12 mm"),
        ("squares = [26, 20]", "squares = [22, 16]", "board around the sheet", "print a larger board"),
        ("well_mm = [-75.0", "well_mm = [505.0", "inside the box, well", "Outside the box"),
        ("x_mm = [200.0, 640.0]", "x_mm = [200.0, 940.0]", "room in the box", "little more"),
        ("park_mm = [250.0, -230.0", "park_mm = [250.0, -100.0", "park beside the board", "in the picture"),
        ("max_depth_mm = 22.0", "max_depth_mm = 47.0", "deepest press", "ferrule"),
        ("dip_z_mm = 122.0", "dip_z_mm = -122.0", "dip above the paper", "teach the well"),
    ],
)
def test_a_value_that_cannot_be_true_is_named_with_its_remedy(
    rig_path: Path, old: str, new: str, name: str, remedy: str
) -> None:
    checks = {check.name: check for check in check_rig(load_rig(rig_file(rig_path.parent, old, new)))}
    assert checks[name].verdict == "contradicts"
    assert checks[name].allowed
    assert remedy in checks[name].remedy


def test_what_is_shown_is_where_the_tip_goes_in_a_picture_with_the_box_and_every_place(
    rig_path: Path, tmp_path: Path
) -> None:
    places = places_of(load_rig(rig_path))
    # Yaw 90: paper x runs along base y, paper y against base x.
    assert places["sheet lower right, deepest press"] == pytest.approx([460.0, 134.0, 98.03])
    assert places["well"] == pytest.approx([310.0, -185.0, 122.0])
    table = brushloop("rig", "show", rig_path).stdout
    assert all(name in table for name in places)
    assert re.search(r"park .* 250\.0 .* -120\.0 .* 210\.0", table)
    rig_file(rig_path.parent, "[ink.device]", WIPE + WASH + "[ink.device]")
    picture = tmp_path / "rig.svg"
    said("rig", "show", rig_path, "--picture", picture)
    drawn = picture.read_text()
    for words in ("from above", "box of limits", "board", "sheet"):
        assert f"<!-- {words}" in drawn, words
    for words in ("well", "wipe, over the rim", "wash pot", "park", "touch point"):
        assert f"<!-- {words} -->" in drawn, words
    assert "must end in" in refused("rig", "show", rig_path, "--picture", tmp_path / "rig.gif")


def test_what_was_taught_says_what_was_never_measured(rig_path: Path) -> None:
    mass = Taught(0.0, "as set on the pendant", known="not weighed")
    Notebook().with_values({"robot.payload_kg": mass}).finished("arm").save(rig_path)
    words = said("rig", "check", rig_path)
    assert "robot.payload_kg 0.0 kg as set on the pendant, not weighed" in words
    assert "not measured step proof" in words
    assert "brushloop rig teach proof --arm" in words
    assert "step arm" not in words


# The doctor


async def test_whatever_is_wrong_is_reported_with_a_remedy_and_every_other_device_is_still_asked(
    wired_lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brushloop.drivers.force.sri_m8123.CONNECT_S", 2.0)
    wired_lab.rig.faults.hang(Fault(device=Device.INK, kind="deaf", count=100))
    wired_lab.rig.faults.hang(Fault(device=Device.FORCE, kind="no-second", count=10_000))
    wired_lab.edit_rig("DICT_5X5_1000", "DICT_4X4_1000")
    wired_lab.rig.arcs.cabinet.safety_stop()
    findings = await examine(load_rig(wired_lab.folder / "rig.toml"), Clock())
    assert not any(finding.well for finding in findings)
    problems = ("board corners found", "no complete reading", "no reply", "ProtectiveStop")
    remedies = ("into view", "wiring", "", "pendant")
    for finding, answers, problem, remedy in zip(findings, (True, False, False, True), problems, remedies, strict=True):
        assert finding.answers is answers
        assert problem in finding.problem
        assert finding.remedy
        assert remedy in finding.remedy
    assert wired_lab.rig.arcs.cabinet.power.safety == SafetyMode.PROTECTIVE_STOP, "not cleared"

    wired_lab.rig.faults.clear()
    wired_lab.edit_rig(f"port = {wired_lab.rig.arcs.port}\n", "port = 9\n")
    ran = await asyncio.to_thread(brushloop, "doctor", "--config", wired_lab.folder / "rig.toml")
    assert (ran.returncode, ran.stderr) == (4, "")
    for words in ("no answer", "127.0.0.1:9", "ink-station"):
        assert words in ran.stdout


def test_a_rig_in_order_is_reported_with_all_that_was_answered_and_left_as_it_was(wired_lab: Lab) -> None:
    report = wired_lab.folder / "report.zip"
    command = ("doctor", "--config", wired_lab.folder / "rig.toml", "--report", report)
    assert "Read it before you send it" in said(*command)
    with zipfile.ZipFile(report) as archive:
        document = json.loads(archive.read("report.json"))
        rtde = json.loads(archive.read("rtde.json"))
    camera, force, ink, robot = document["findings"]
    assert all(finding["well"] for finding in document["findings"])
    assert robot["identity"] == "aubo_i5 (brushloop-loopback)"
    assert robot["latency_ms"] > 0.0
    assert "PowerOff, safety Normal, simulated" in robot["notes"]
    assert camera["notes"].startswith("board: ")
    assert "readings/s" in force["notes"]
    assert (ink["identity"], ink["firmware"], ink["notes"]) == ("ink-station", "1.0.0", "well 71% full, simulated")
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
    lines = Replayed(report).lines
    answered = {line["method"]: line["answer"] for line in lines}
    assert answered["rob1.RobotState.getSafetyModeType"] == {"result": "Normal"}
    assert answered["rob1.MotionControl.getSpeedFraction"]["result"] == 1.0
    assert all(line["took_ms"] > 0.0 for line in lines)
    assert (wired_lab.rig.arcs.cabinet.power.mode, wired_lab.rig.world.motion._next_id) == ("PowerOff", 0)
    before = report.read_bytes()
    assert "is not overwritten" in refused(*command)
    assert report.read_bytes() == before


def test_names_addresses_and_paths_stay_in_the_lab(rig_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRUSHLOOP_ROBOT__HOST", "arm7.lab.example")
    monkeypatch.setenv("LOGNAME", "wanghui")
    monkeypatch.setattr("socket.gethostname", lambda: "rigpc")
    scrubber = Scrubber(load_rig(rig_path).model_dump(mode="json"))
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


def test_on_the_first_day_there_is_no_rig_yet_and_the_archive_holds_what_is_known(wired_lab: Lab) -> None:
    robot = load_rig(wired_lab.folder / "rig.toml").robot
    rig, report = wired_lab.folder / "new.toml", wired_lab.folder / "report.zip"
    address = Taught(f"{robot.host}:{robot.port}", "typed")
    stream = Taught("http://cam.example/stream", "typed")
    squares = Taught([26.0, 20.0], "typed")
    values = {"aside.address": address, "camera.source": stream, "board.squares": squares}
    Notebook().with_values(values).save(rig)
    assert "new.toml yet" in said("doctor", "--config", rig, "--report", report)
    archive = Replayed(report)
    answered = {line["method"]: line["answer"] for line in archive.lines}
    assert answered["rob1.RobotState.getSafetyModeType"] == {"result": "Normal"}
    with zipfile.ZipFile(report) as held:
        text = held.read("report.json").decode()
    assert json.loads(text)["rig"]["board.squares"] == [26, 20]
    assert robot.host not in text
    assert "cam.example" not in text
