"""A loopback rig in a process of its own, at a pace that its camera keeps up with, and commands as one types them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from brushloop.drivers.loopback import LoopbackRig, simulate


def brushloop(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "brushloop", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@dataclass
class Bench:
    """A rig that serves, and a folder for everything."""

    folder: Path
    simulated: LoopbackRig

    def run(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        return brushloop(*words)

    @property
    def rig(self) -> Path:
        return self.simulated.config

    @property
    def sessions(self) -> Path:
        return self.folder / "sessions"

    def fresh_sheet(self) -> None:
        self.simulated.fresh_sheet()

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
def bench(tmp_path: Path) -> Iterator[Bench]:
    """`brushloop sim`, seed 1, its camera as sharp and as slow as it comes."""
    with simulate(tmp_path) as rig:
        yield Bench(tmp_path, rig)
