"""`brushloop collect` without a screen: signals, exit codes, and what is printed at the end and after the screen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock, PropertyMock

import pytest

from brushloop.collect import start
from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import Engine
from brushloop.collect.errors import CollectAborted, ConfigError
from brushloop.collect.rig.devices import sole_driver
from brushloop.drivers import host as sole
from brushloop.drivers.sim.faults import ALWAYS, Device, Fault, Phase
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore
from tests.collect.tui.fake import picture
from tests.command import refused
from tests.rigs import Lab
from tests.runs import ended_by, until
from tests.waiting import wait_until


def at_each_mark(lab: Lab, monkeypatch: pytest.MonkeyPatch, number: signal.Signals) -> None:
    """Send this process a signal whenever a press has left its mark."""
    leave = lab.rig.world._leave_mark

    def leave_and_send(deepest: Any) -> None:
        leave(deepest)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(lab.rig.world, "_leave_mark", leave_and_send)


def test_a_signal_stops_the_run_and_the_same_command_goes_on_where_no_other_has_the_session(
    bare_lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = bare_lab
    lab.write_protocol()
    with monkeypatch.context() as patch:
        at_each_mark(lab, patch, signal.SIGTERM)
        ran = lab.command()
    assert ran.returncode == 4, ran.stderr
    last = ran.stderr.splitlines()[-1]
    assert last.startswith("brushloop: stopped; the session can be resumed with the same command")
    assert "Traceback" not in ran.stderr
    assert lab.at_rest

    elsewhere, at = SessionStore(lab.session, lambda: 1), lab.rig.world.tool()
    refused = lab.command()
    assert (refused.returncode, lab.rig.world.tool()) == (2, at), "nothing moves"
    assert refused.stderr.splitlines()[-1].endswith("another brushloop has this session open")
    elsewhere.release()

    again = lab.command()
    assert again.returncode == 0, again.stderr
    recorded = f"recorded: {lab.session}/{lab.session.name}.mcap"
    assert again.stdout.splitlines() == [recorded, f"next:     brushloop analyse {lab.session}"]
    assert len({c.stroke.stroke_id for c in Recording(lab.session).captures()}) == 2


@pytest.mark.parametrize("goes_away", ["output", "terminal"])
def test_where_nobody_watches_any_more_the_step_ends_and_the_arm_parks(
    bare_lab: Lab, monkeypatch: pytest.MonkeyPatch, goes_away: str
) -> None:
    """Nobody is there to lift a brush that was stopped on the paper."""
    lab = bare_lab

    def output_closed(_engine: Engine) -> None:
        wait_until(lambda: lab.rig.world.presses, "a press")
        raise BrokenPipeError

    if goes_away == "output":
        monkeypatch.setattr(start, "show_progress", output_closed)
    else:
        at_each_mark(lab, monkeypatch, signal.SIGHUP)  # a shell may pass it on again
    lab.write_protocol(repeats=10)
    ran = lab.command()
    assert (ran.returncode, ran.stdout) == (4, "")
    last = ran.stderr.splitlines()[-1]
    assert last.startswith("brushloop: parked on request; the session can be resumed with the same command")
    assert lab.rig.faults.phase() is Phase.PARKED
    assert not lab.state.cut


# One arm, one driver: whatever the temporary folder, whoever the user, and for no longer than the process lives

ARM = "127.0.0.1", 1 + os.getpid() % 60_000
"""No other test has this address; nothing connects to it."""
HOLD = """
import encodings.idna, os, sys, time
from brushloop.collect.rig.devices import sole_driver
if len(sys.argv) > 3:
    os.setuid(int(sys.argv[3]))
with sole_driver(sys.argv[1], int(sys.argv[2])):
    print("has it", flush=True)
    time.sleep(600)
"""
NOBODY = 65534
ROOT = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root becomes another user")


@pytest.mark.parametrize("user", [(), pytest.param((str(NOBODY),), marks=ROOT)], ids=["same user", "another user"])
def test_a_second_driver_is_refused_while_the_first_lives_and_not_afterwards(tmp_path: Path, user: tuple[str, ...]):
    """Whatever its temporary folder."""
    command, environment = [sys.executable, "-c", HOLD, *map(str, ARM), *user], {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "has it\n"
            who = rf"another brushloop is driving the arm at 127.*: process {holder.pid} of "
            with pytest.raises(ConfigError, match=who):
                sole_driver(*ARM).__enter__()
        finally:
            holder.kill()
    with sole_driver(*ARM):
        pass


def test_where_the_kernel_keeps_no_names_a_lock_that_all_may_open_does(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sole.sys, "platform", "darwin")
    for _ in range(2):
        with sole_driver(*ARM), pytest.raises(ConfigError, match="cannot be named"):
            sole_driver(*ARM).__enter__()
    for left in Path("/tmp").glob("brushloop-arm-*.lock"):
        assert left.stat().st_mode & 0o777 == 0o666
        left.unlink()


# What is refused first, and what is printed last


def test_a_folder_that_may_not_be_written_is_refused_before_anything_is_connected(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("collect", "--no-tui", *lab.options)
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.sessions.disk.os.access", lambda path, _mode: path != lab.folder)
        assert refused(*command) == f"{lab.folder}: may not be written: it is read-only, or another user's"
    lab.sessions.write_text("not a folder", encoding="utf-8")
    assert refused(*command) == f"{lab.sessions}: is a file; a folder is needed"
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"


# An arm that no longer sends its pose: every screen says so after a second, long before a call times out


def test_the_snapshot_says_for_how_long_no_pose_has_come(bare_lab: Lab) -> None:
    engine, faults = bare_lab.engine(), bare_lab.rig.faults
    assert engine.snapshot().no_pose_s is None, "not connected yet"
    engine.control.pause()
    engine.start()
    until(engine, lambda now: now.state is State.PAUSED and now.tip_mm is not None)
    faults.hang(Fault(device=Device.TELEMETRY, kind="mute", count=ALWAYS))
    faults.hang(Fault(device=Device.ROBOT, kind="mute", on="getTcpPose", count=ALWAYS))
    assert until(engine, lambda now: now.tip_mm is None).no_pose_s is None, "not for a second yet"
    for shown_s in (1.0, 20.0):
        now = until(engine, lambda now, least_s=shown_s: (now.no_pose_s or 0.0) >= least_s)
        assert (now.tip_mm, now.no_pose_s) == (None, pytest.approx(shown_s, abs=0.1))
    faults.clear()
    assert until(engine, lambda now: now.tip_mm is not None).no_pose_s is None, "it sends again"
    engine.stop()
    ended_by(engine, CollectAborted)
    bare_lab.rig.time.pass_s(30.0)
    assert engine.snapshot().no_pose_s is None, "a run that is over has let the arm go"


def test_without_a_screen_it_is_one_line_when_it_begins_and_one_when_it_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shots = [picture(messages=(), no_pose_s=s) for s in (None, None, 1.04, 1.1, 2.0, None)]
    scripted = Mock(snapshot=lambda: shots.pop(0))
    type(scripted).finished = PropertyMock(side_effect=lambda: len(shots) == 1)
    monkeypatch.setattr(start, "REFRESH_S", 0.0)
    start.show_progress(scripted)
    printed = [line for line in capsys.readouterr().err.splitlines() if "pose" in line]
    assert printed == ["warning: no pose for 1.0 s", "the arm sends its pose again"]
