"""A loopback rig in a process of its own, at a pace that its camera keeps up with, and commands as one types them."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.waiting import wait_until


def brushloop(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "brushloop", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@dataclass
class Bench:
    """A rig that serves, and a folder for everything."""

    folder: Path
    process: subprocess.Popen[bytes]
    run: Callable[..., subprocess.CompletedProcess[str]] = field(default=brushloop)

    @property
    def rig(self) -> Path:
        return self.folder / "rig.toml"

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"

    def fresh_sheet(self) -> None:
        self.process.send_signal(signal.SIGUSR1)

    def collect(self, protocol: str) -> Path:
        """One session of a protocol; returns its folder."""
        path = self.folder / "protocol.toml"
        path.write_text(protocol, encoding="utf-8")
        before = set(self.sessions.iterdir()) if self.sessions.is_dir() else set[Path]()
        ran = brushloop("collect", "--config", self.rig, "--protocol", path, "--out", self.sessions, "--no-tui")
        assert ran.returncode == 0, ran.stderr
        [session] = set(self.sessions.iterdir()) - before
        return session


@pytest.fixture
def at_rate() -> float:
    """Simulated seconds per real second."""
    return 30.0


@pytest.fixture
def bench(tmp_path: Path, at_rate: float) -> Iterator[Bench]:
    """`brushloop sim`, seed 1, its camera as sharp and as slow as it comes."""
    command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(tmp_path / "rig.toml")]
    with ExitStack() as stack:
        log = stack.enter_context((tmp_path / "rig.log").open("wb"))
        process = stack.enter_context(subprocess.Popen([*command, "--rate", str(at_rate)], stdout=log, stderr=log))
        stack.callback(process.terminate)
        wait_until(lambda: b"Ctrl-C ends" in (tmp_path / "rig.log").read_bytes(), "the rig", process=process)
        yield Bench(tmp_path, process)
