"""One arm, one driver: whatever the temporary folder, whoever the user, and for no longer than the process lives."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.devices import sole_driver
from brushloop.drivers import host as sole

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
