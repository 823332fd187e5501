"""The processes that draw for a twin."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import wait_until
from twin.run import TwinStopped, workers

WORKING = """
import os, time
from twin.run import workers

if __name__ == "__main__":
    with workers(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 1000.0).result()
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


def test_a_worker_that_ends_first_stops_the_command_in_one_line() -> None:
    with pytest.raises(TwinStopped, match="the same command continues"), workers(1) as pool:
        pool.submit(os._exit, 1).result()
