"""`brushloop collect` as a process: beside a second one, and on a disk that is really full or may not be written."""

from __future__ import annotations

import tomllib

import pytest

from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.recording import Recording
from brushloop.sessions.verify import verify_session
from tests.collect.durability.conftest import Disk, parked, the_session
from tests.journal_lines import read_lines
from tests.rigs import COARSE, Lab, serving
from tests.waiting import PATIENCE_S, wait_until


def where(rig: LoopbackRig) -> dict[str, str]:
    """The environment that points a configuration at this rig's devices: machine names may differ in a session."""
    devices = tomllib.loads(rig.toml())
    return {
        "BRUSHLOOP_ROBOT__PORT": str(devices["robot"]["port"]),
        "BRUSHLOOP_ROBOT__RTDE_PORT": str(devices["robot"]["rtde_port"]),
        "BRUSHLOOP_CAMERA__SOURCE": devices["camera"]["source"],
        "BRUSHLOOP_FORCE__PORT": str(devices["force"]["port"]),
        "BRUSHLOOP_INK__DEVICE__PORT": devices["ink"]["device"]["port"],
    }


def test_a_session_that_is_open_elsewhere_is_refused_before_anything_is_powered(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.write_protocol(repeats=3, dwell_s=60.0)  # each press takes a second: the first run outlives the second
    with serving(COARSE) as rig:
        first = lab.process()
        wait_until(lambda: lab.rig.world.presses, "the first press")
        for name, value in where(rig).items():
            monkeypatch.setenv(name, value)
        second = lab.command()  # this process is the second
        assert second.returncode == 2, second.stderr
        assert second.stderr.splitlines()[-1].endswith("another brushloop has this session open")
        assert rig.arcs.cabinet.power.mode == "PowerOff"
        assert not rig.world.presses
    _, stderr = first.communicate(timeout=PATIENCE_S)
    assert first.returncode == 0, stderr
    assert verify_session(the_session(lab)).sound


def wait_for_a_file(lab: Lab, pattern: str) -> None:
    wait_until(lambda: any(lab.sessions.glob(f"*/{pattern}")), pattern)


def run(lab: Lab) -> tuple[int, str]:
    ran = lab.command()
    assert "Traceback" not in ran.stderr
    return ran.returncode, ran.stderr.splitlines()[-1]


def test_a_disk_that_fills_up_in_mid_step_parks_the_arm_and_with_room_the_same_command_goes_on(
    lab: Lab, disk: Disk
) -> None:
    first = lab.process()
    wait_for_a_file(lab, "*-press-*.mcap.part")
    disk.fill()
    _, stderr = first.communicate(timeout=PATIENCE_S)
    assert first.returncode == 4, stderr
    assert "Traceback" not in stderr
    assert "No space left on device" in stderr.splitlines()[-1] or "make room" in stderr.splitlines()[-1]
    assert parked(lab)
    folder = the_session(lab)
    finished = {(step.file, step.sha256) for step in replay(folder / JOURNAL_NAME).files.values()}

    assert run(lab)[0] == 4, "there is no more room than before"
    disk.make_room()
    assert run(lab)[0] == 0
    assert finished <= {(step.file, step.sha256) for step in replay(folder / JOURNAL_NAME).files.values()}
    assert len({capture.stroke.stroke_id for capture in Recording(folder).captures()}) == 2
    begun = [line for line in read_lines(folder / JOURNAL_NAME) if line["event"] == "begin"]
    patches = [patch for line in begun for patch in line["patches"]]
    assert len(patches) == len(set(patches))
    assert verify_session(folder).sound


def test_a_folder_that_may_not_be_written_is_refused_before_anything_is_connected(lab: Lab, disk: Disk) -> None:
    disk.read_only(True)
    code, printed = run(lab)
    assert (code, printed) == (2, f"brushloop: {lab.sessions}: may not be written: it is read-only, or another user's")
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"

    disk.read_only(False)
    first = lab.process()
    wait_for_a_file(lab, "*-press-*.mcap")
    first.kill()
    first.communicate()
    disk.read_only(True)
    code, printed = run(lab)
    folder = the_session(lab)
    assert (code, printed) == (2, f"brushloop: {folder}: may not be written: it is read-only, or another user's")
    assert verify_session(folder).sound, "looking needs no right to write"
    disk.read_only(False)
    assert run(lab)[0] == 0


def test_a_file_in_place_of_the_folder_is_refused(lab: Lab) -> None:
    lab.sessions.write_text("not a folder", encoding="utf-8")
    assert run(lab) == (2, f"brushloop: {lab.sessions}: is a file; a folder is needed")
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"
