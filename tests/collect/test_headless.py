"""`brushloop collect` without a screen, as a process: signals, exit codes, two at once."""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING

import pytest

from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.recording import Recording
from tests.command import brushloop
from tests.waiting import PATIENCE_S, wait_until

if TYPE_CHECKING:
    from tests.rigs import Lab


@pytest.fixture
def lab(wired_lab: Lab) -> Lab:
    return wired_lab


def wait_for_presses(lab: Lab, count: int) -> None:
    wait_until(lambda: len(lab.rig.world.presses) >= count, f"{count} presses", process=lab.processes[-1])


def test_a_signal_stops_the_arm_and_the_same_command_goes_on(lab: Lab) -> None:
    lab.write_protocol("[11.0, 13.0]", "[0.0, 10.0]")
    for number in (signal.SIGINT, signal.SIGTERM):
        first = lab.process()
        wait_for_presses(lab, len(lab.rig.world.presses) + 1)
        first.send_signal(number)
        _, stderr = first.communicate(timeout=PATIENCE_S)
        assert first.returncode == 4, stderr
        assert stderr.splitlines()[-1].startswith("brushloop: stopped; the same command resumes from here")
        assert "Traceback" not in stderr
        still = lab.rig.world.tool()
        time.sleep(0.1)
        assert lab.rig.world.tool() == still

    again = brushloop("collect", "--no-tui", *lab.options)
    assert again.returncode == 0, again.stderr
    [folder] = lab.sessions.iterdir()
    assert again.stdout.splitlines() == [
        f"recorded: {folder / folder.name}.mcap",
        f"next:     brushloop calibrate {folder}",
    ]
    assert len({c.stroke.stroke_id for c in Recording(folder).captures()}) == 4


def test_a_run_whose_terminal_is_closed_finishes_its_step_and_parks(lab: Lab) -> None:
    lab.write_protocol(repeats=10)
    run = lab.process()
    wait_for_presses(lab, 1)
    for _ in range(2):  # a shell whose window is closed may pass the signal on as well
        run.send_signal(signal.SIGHUP)
    _, stderr = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 4
    assert stderr.splitlines()[-1] == "brushloop: parked on request; the same command resumes from here"
    assert lab.rig.faults.phase() is Phase.PARKED
    [folder] = lab.sessions.iterdir()
    assert not replay(folder / JOURNAL_NAME).cut


def test_a_signal_says_that_the_brush_may_be_down_where_it_may(lab: Lab) -> None:
    lab.write_protocol("[20.0]", dwell_s=60.0)
    run = lab.process()
    deep_mm = lab.rig.config.table.paper_z_mm - 10.0
    wait_until(lambda: lab.rig.world.tool().z_mm < deep_mm, "the brush in the paper")
    run.send_signal(signal.SIGHUP)
    time.sleep(0.1)
    run.send_signal(signal.SIGTERM)  # does not wait for the end of the press
    _, stderr = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 4
    assert "brush may be down" in stderr.splitlines()[-1]
    assert lab.rig.faults.phase() is not Phase.PARKED


def test_a_second_process_is_refused_and_the_first_goes_on(lab: Lab) -> None:
    lab.write_protocol(repeats=10)  # far longer than the second needs to be refused
    first = lab.process()
    wait_for_presses(lab, 1)
    second = brushloop("collect", "--no-tui", *lab.options)  # this process is the second
    assert second.returncode == 2
    assert "another brushloop is driving the arm" in second.stderr.splitlines()[-1]
    pressed = len(lab.rig.world.presses)
    wait_for_presses(lab, pressed + 2)
    assert first.poll() is None
