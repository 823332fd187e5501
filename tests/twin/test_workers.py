"""The processes that draw for a twin."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from brushloop.twin.run import TwinStopped, workers
from tests.waiting import PATIENCE_S, wait_until

WORKING = """
import os, time
from brushloop.twin.run import workers

if __name__ == "__main__":
    with workers(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 1000.0).result()
"""


DRAWING = """
import time
from brushloop.twin.run import workers

if __name__ == "__main__":
    with workers(1) as pool:
        print(pool.submit(int).result(), flush=True)
        list(pool.map(time.sleep, [0.1] * 10_000))
"""


def runs(pid: int) -> bool:
    try:
        return "(zombie)" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def test_a_worker_ends_with_the_command_that_was_killed(tmp_path: Path) -> None:
    script = tmp_path / "working.py"
    script.write_text(WORKING)
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    started = [sys.executable, str(script)]
    with subprocess.Popen(started, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": paths}) as command:
        assert command.stdout is not None
        worker = int(command.stdout.readline())
        assert runs(worker)
        command.send_signal(signal.SIGKILL)
    wait_until(lambda: not runs(worker), "the worker's end")


def test_a_command_that_is_terminated_leaves_nothing_behind(tmp_path: Path) -> None:
    script = tmp_path / "drawing.py"
    script.write_text(DRAWING)
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    ) as command:
        assert command.stdout is not None
        assert command.stdout.readline() == "0\n"
        command.send_signal(signal.SIGTERM)
        _, said = command.communicate(timeout=PATIENCE_S)
    assert said.splitlines()[-1] == "brushloop.twin.run.TwinStopped: SIGTERM: the same command continues"
    assert "leaked" not in said


def test_a_worker_that_ends_first_stops_the_command_in_one_line() -> None:
    with pytest.raises(TwinStopped, match="the same command continues"), workers(1) as pool:
        pool.submit(os._exit, 1).result()
