"""A disk of its own for the sessions, that can be filled up or made read-only for real."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.journal import JOURNAL_NAME

if TYPE_CHECKING:
    from tests.rigs import Lab

DISK_MIB = 90
"""A step is begun with 80 MiB free or more."""


@dataclass
class Disk:
    """A file system in memory, mounted on the folder of sessions."""

    folder: Path

    def fill(self) -> None:
        """Take all the room that is left."""
        with (self.folder / "filler").open("ab", buffering=0) as file:
            for size in (1 << 20, 1 << 12, 1):
                with contextlib.suppress(OSError):
                    while True:
                        file.write(bytes(size))

    def make_room(self) -> None:
        (self.folder / "filler").unlink()

    def read_only(self, yes: bool) -> None:
        subprocess.run(["mount", "-o", f"remount,{'ro' if yes else 'rw'}", self.folder], check=True)


@pytest.fixture
def lab(wired_lab: Lab) -> Lab:
    return wired_lab


@pytest.fixture
def disk(lab: Lab) -> Iterator[Disk]:
    lab.sessions.mkdir()
    size = f"size={DISK_MIB}m"
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", lab.sessions], capture_output=True, check=False)
    if made.returncode != 0:
        pytest.skip("needs the right to mount; in memory alone this is held by tests/collect/faults/test_slow_disk.py")
    yield Disk(lab.sessions)
    for process in lab.processes:
        process.kill()
        process.wait()
    subprocess.run(["umount", lab.sessions], check=True)


def the_session(lab: Lab) -> Path:
    """The one session that there is."""
    [journal] = lab.sessions.glob(f"*/{JOURNAL_NAME}")
    return journal.parent


def at_rest_above_the_paper(lab: Lab) -> bool:
    """Nothing moves or is queued, and the brush touches nothing."""
    cabinet = lab.rig.arcs.cabinet
    moving = cabinet.motion.exec_id(cabinet.now_s()) != -1
    return not moving and lab.rig.world.tool().z_mm >= lab.rig.config.table.paper_z_mm + 7.0


def parked(lab: Lab) -> bool:
    """At rest where the arm waits, out of the camera's view."""
    return at_rest_above_the_paper(lab) and lab.rig.faults.phase() is Phase.PARKED
