"""Fixtures for a lab's own tests: `brushloop_rig` and `brushloop_twin`, loaded by pytest where brushloop is installed.

Each is a loopback rig in a process of its own, which ends with the test. Nothing that it presses is a result on paper.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

START_S = 120.0
"""Longest start; a busy machine may need most of it."""
POLL_S = 0.05
RATE = 30.0
TWIN_INI = "brushloop_twin"


class RigDidNotStart(RuntimeError):
    """The loopback rig ended, or did not write its file in time; holds what it printed."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the ini option that names the twin."""
    parser.addini(TWIN_INI, "twin.toml that the fixture `brushloop_twin` presses with", type="paths")


@pytest.fixture
def brushloop_rig(tmp_path: Path) -> Generator[Path]:
    """`rig.toml` of a running loopback rig with the default brush."""
    with loopback_rig(tmp_path) as rig:
        yield rig


@pytest.fixture
def brushloop_twin(tmp_path: Path, request: pytest.FixtureRequest) -> Generator[Path]:
    """`rig.toml` of a running loopback rig that presses with the twin which the ini option `brushloop_twin` names."""
    named: list[Path] = request.config.getini(TWIN_INI)
    if len(named) != 1:
        raise pytest.UsageError(f"{TWIN_INI}: name one twin.toml in pytest's settings; `brushloop twin` makes it")
    with loopback_rig(tmp_path, "--brush", str(named[0])) as rig:
        yield rig


@contextmanager
def loopback_rig(folder: Path, *options: str) -> Generator[Path]:
    """Serve a loopback rig until the end of the block and give its `rig.toml`. Raises `RigDidNotStart`."""
    rig, log = folder / "brushloop-rig.toml", folder / "brushloop-rig.log"
    command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(rig), "--rate", str(RATE), *options]
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file)
    try:
        deadline = time.monotonic() + START_S
        while not rig.exists():
            if process.poll() is not None or time.monotonic() > deadline:
                raise RigDidNotStart(log.read_text(encoding="utf-8", errors="replace"))
            time.sleep(POLL_S)
        yield rig
    finally:
        process.terminate()
        process.wait()
