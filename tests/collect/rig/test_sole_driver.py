"""One arm, one driver: whatever the temporary folder, whoever the user, and for no longer than the process lives."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.devices import sole_driver
from brushloop.drivers import host as sole
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import rig_toml

HOLD = """
import encodings.idna, os, sys, time
from pathlib import Path
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import sole_driver
rig = load_rig(Path(sys.argv[1]))
if len(sys.argv) > 2:
    os.setuid(int(sys.argv[2]))
with sole_driver(rig.robot.host, rig.robot.port):
    print("has it", flush=True)
    time.sleep(600)
"""
NOBODY = 65534


@pytest.fixture
def path(tmp_path: Path) -> Path:
    # No other test has this address; nothing connects to it.
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(SimConfig(), ports={"arcs": 1 + os.getpid() % 60_000}))
    return path


@pytest.fixture
def rig(path: Path) -> RigConfig:
    return load_rig(path)


@pytest.fixture
def holder(path: Path, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Another process that has the arm, with a temporary folder of its own."""
    processes: list[subprocess.Popen[str]] = []

    def hold(*more: str) -> subprocess.Popen[str]:
        (tmp_path / "its own").mkdir()
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(path), *more],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": str(tmp_path / "its own")},
        )
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "has it\n"
        return process

    yield hold
    for process in processes:
        process.kill()
        process.communicate()


ROOT = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root becomes another user")


@pytest.mark.parametrize("user", [(), pytest.param((str(NOBODY),), marks=ROOT)], ids=["same user", "another user"])
def test_a_second_driver_is_refused_while_the_first_lives_and_not_afterwards(
    rig: RigConfig, holder: Callable[..., subprocess.Popen[str]], user: tuple[str, ...]
):
    """Whatever its temporary folder."""
    process = holder(*user)
    with pytest.raises(ConfigError, match=rf"another brushloop is driving the arm at 127.*: process {process.pid} of "):
        sole_driver(rig.robot.host, rig.robot.port).__enter__()
    process.kill()
    process.wait()
    with sole_driver(rig.robot.host, rig.robot.port):
        pass


def test_where_the_kernel_keeps_no_names_a_lock_that_all_may_open_does(rig: RigConfig, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sole.sys, "platform", "darwin")
    for _ in range(2):
        with sole_driver(rig.robot.host, rig.robot.port), pytest.raises(ConfigError, match="cannot be named"):
            sole_driver(rig.robot.host, rig.robot.port).__enter__()
    for left in Path("/tmp").glob("brushloop-arm-*.lock"):
        assert left.stat().st_mode & 0o777 == 0o666
        left.unlink()
