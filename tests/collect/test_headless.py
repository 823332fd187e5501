"""`brushloop collect` without a screen: signals, exit codes, and what is printed at the end and after the screen."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from brushloop.collect.errors import Parked
from brushloop.collect.start import CollectRequest, collect, ending
from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore
from tests.rigs import Lab
from tests.runs import until, wait_for_end
from tests.waiting import PATIENCE_S, wait_until


def at_each_press(lab: Lab, do: Callable[[], object]) -> None:
    """Do something whenever a press has left its mark."""
    leave = lab.rig.world._leave_mark
    lab.rig.world._leave_mark = lambda deepest: (leave(deepest), do())[0]  # type: ignore[method-assign]


def test_a_signal_stops_the_process_and_the_same_command_goes_on(wired_lab: Lab) -> None:
    """SIGTERM to a process of its own; the command that goes on is this process."""
    lab = wired_lab
    lab.write_protocol("[11.0, 13.0]")
    run = lab.process()
    wait_until(lambda: lab.rig.world.presses, "a press", process=run)
    run.send_signal(signal.SIGTERM)
    _, stderr = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 4, stderr
    assert stderr.splitlines()[-1].startswith("brushloop: stopped; the same command resumes from here")
    assert "Traceback" not in stderr
    assert lab.at_rest

    again = lab.command()
    assert again.returncode == 0, again.stderr
    assert again.stdout.splitlines() == ending(lab.session, "grid")
    assert len({c.stroke.stroke_id for c in Recording(lab.session).captures()}) == 2


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (signal.SIGINT, "stopped; the same command resumes from here"),
        (signal.SIGHUP, "parked on request; the same command resumes from here"),
    ],
)
def test_a_signal_ends_the_run(lab: Lab, number: signal.Signals, says: str) -> None:
    """Where the terminal was closed, it finishes its step and parks: nobody is there to lift the brush."""
    lab.write_protocol(repeats=10)
    at_each_press(lab, lambda: os.kill(os.getpid(), number))  # a shell whose window is closed may pass it on again
    ran = lab.command()
    assert (ran.returncode, ran.stdout) == (4, "")
    assert ran.stderr.splitlines()[-1].startswith(f"brushloop: {says}")
    if number == signal.SIGHUP:
        assert lab.rig.faults.phase() is Phase.PARKED
        assert not replay(lab.session / JOURNAL_NAME).cut


def test_a_session_that_is_open_elsewhere_is_refused_before_anything_moves(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 1)
    engine.park()
    with pytest.raises(Parked):
        wait_for_end(engine)
    elsewhere = SessionStore(lab.session, lab.rig.time.now_ns)
    at = lab.rig.world.tool()
    ran = lab.command()
    assert (ran.returncode, lab.rig.world.tool()) == (2, at)
    assert ran.stderr.splitlines()[-1].endswith("another brushloop has this session open")
    elsewhere.release()
    assert lab.command().returncode == 0


def test_a_folder_that_may_not_be_written_is_refused_before_anything_is_connected(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.sessions.disk.os.access", lambda path, _mode: path != lab.folder)
        ran = lab.command()
    said = f"brushloop: {lab.folder}: may not be written: it is read-only, or another user's"
    assert (ran.returncode, ran.stderr.splitlines()[-1]) == (2, said)
    lab.sessions.write_text("not a folder", encoding="utf-8")
    ran = lab.command()
    said = f"brushloop: {lab.sessions}: is a file; a folder is needed"
    assert (ran.returncode, ran.stderr.splitlines()[-1]) == (2, said)
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"


def test_the_recording_and_what_comes_next(tmp_path: Path) -> None:
    folder = tmp_path / "grid-01"
    recorded = f"recorded: {folder}/grid-01.mcap"
    assert ending(folder, "grid") == [recorded, f"next:     brushloop calibrate {folder}"]
    (folder / "calibration").mkdir(parents=True)
    assert ending(folder, "list") == [recorded, f"next:     brushloop validate {folder}"]
    assert ending(folder, "calibration") == [recorded]


def test_the_ending_is_printed_after_the_screen_too(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.write_protocol("[11.0]")
    monkeypatch.setattr("brushloop.collect.tui.app.run_app", lambda app: (app.engine.start(), wait_for_end(app.engine)))
    rig, protocol = lab.folder / "rig.toml", lab.folder / "protocol.toml"
    done = collect(CollectRequest(rig, protocol, lab.sessions, on_screen=True))
    assert done == (lab.session, 0)
    assert capsys.readouterr().out.splitlines() == ending(lab.session, "grid")
    assert (lab.session / f"{lab.session.name}.mcap").is_file()
