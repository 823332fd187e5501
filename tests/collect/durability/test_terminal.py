"""The terminal is closed while a run is on, a lost ssh say: the arm parks, the session stays whole, it goes on."""

from __future__ import annotations

import fcntl
import os
import select
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import pytest

from brushloop.sessions.recording import Recording
from brushloop.sessions.verify import verify_session
from tests.collect.durability.conftest import parked, the_session
from tests.waiting import PATIENCE_S, wait_until

if TYPE_CHECKING:
    from tests.rigs import Lab

ROWS, COLUMNS = 40, 120

pytestmark = pytest.mark.soak


@contextmanager
def terminal() -> Iterator[tuple[int, int]]:
    """(its own end, the end for a program); both are closed in the end."""
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    try:
        yield ours, theirs
    finally:
        for end in (ours, theirs):
            with suppress(OSError):  # closed already
                os.close(end)


def in_terminal(lab: Lab, end: int, *options: str) -> subprocess.Popen[str]:
    """`brushloop collect` with that terminal as its own: it hangs up with it."""
    command = [sys.executable, "-m", "brushloop", "collect", *options, "--out", str(lab.sessions)]
    command += ["--config", str(lab.folder / "rig.toml"), "--protocol", str(lab.folder / "protocol.toml")]
    take = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", take, *command],
        stdin=end,
        stdout=end,
        stderr=end,
        start_new_session=True,
        env={**os.environ, "TERM": "xterm-256color"},
        text=True,
    )
    lab.processes.append(process)
    os.close(end)
    return process


def read_until(end: int, condition: Callable[[], bool]) -> None:
    def met() -> bool:
        if select.select([end], [], [], 0.0)[0]:
            os.read(end, 65536)
        return condition()

    wait_until(met, "what the terminal is to show")


@pytest.mark.parametrize("option", ["--tui", "--no-tui"])
def test_a_terminal_that_is_closed_parks_the_arm_and_the_same_command_goes_on(lab: Lab, option: str) -> None:
    with terminal() as (ours, theirs):
        process = in_terminal(lab, theirs, option)
        read_until(ours, lambda: len(lab.rig.world.presses) >= 1)
        os.close(ours)
        assert process.wait(timeout=PATIENCE_S) == 4
    still = lab.rig.world.tool()
    time.sleep(0.1)
    assert lab.rig.world.tool() == still
    assert parked(lab)
    folder = the_session(lab)
    assert verify_session(folder).sound

    again = lab.process()
    _, stderr = again.communicate(timeout=PATIENCE_S)
    assert again.returncode == 0, stderr
    assert len({capture.stroke.stroke_id for capture in Recording(folder).captures()}) == 2
    assert verify_session(folder).sound
