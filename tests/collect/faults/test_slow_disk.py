"""A disk that is slow or fills up: the recorder's side of a session, the arm's safety included.

The disk belongs to the process that records, so it is no fault of the rig. What the writer alone does, and a disk that
does not keep up, is in tests/sessions/test_writer.py.
"""

from __future__ import annotations

import errno
import os
import time
from dataclasses import dataclass
from typing import Any

import pytest

from brushloop.collect.engine.control import State
from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.errors import SessionError
from brushloop.sessions.mcap_writer import McapWriter
from brushloop.sessions.recording import Recording
from tests.journal_lines import read_lines
from tests.rigs import Lab


@dataclass
class Disk:
    """What every file of the session is written to."""

    message_s: float = 0.0
    """Time that one message takes."""
    sync_s: float = 0.0
    full_after: int | None = None
    """Messages after which nothing more fits."""
    written: int = 0


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk, add, fsync = Disk(), McapWriter.record, os.fsync

    def slow_add(table: McapWriter, outgoing: Any) -> None:
        time.sleep(disk.message_s)
        disk.written += 1
        if disk.full_after is not None and disk.written > disk.full_after:
            raise OSError(errno.ENOSPC, "No space left on device")
        add(table, outgoing)

    def slow_fsync(handle: int) -> None:
        time.sleep(disk.sync_s)
        fsync(handle)

    monkeypatch.setattr(McapWriter, "record", slow_add)
    monkeypatch.setattr(os, "fsync", slow_fsync)
    return disk


def test_a_slow_disk_is_waited_for_and_loses_nothing(bare_lab: Lab, disk: Disk) -> None:
    disk.message_s, disk.sync_s = 0.012, 0.05  # a pose comes every 0.010 s
    bare_lab.run()
    assert sum(bare_lab.state.counts().values()) == disk.written
    assert len(list(Recording(bare_lab.session).captures())) == 1


@pytest.mark.parametrize("full_after", [0, 3, pytest.param(60, marks=pytest.mark.soak)])
def test_a_disk_that_fills_up_ends_the_run_and_with_room_the_same_command_goes_on(
    bare_lab: Lab, disk: Disk, full_after: int
) -> None:
    disk.full_after = full_after
    with pytest.raises(SessionError, match="No space left on device"):
        bare_lab.run()
    assert bare_lab.engines[-1].snapshot().state is State.FAILED
    assert bare_lab.at_rest
    assert bare_lab.rig.faults.phase() in (Phase.PARKED, Phase.RESTING)
    assert bare_lab.rig.world.tool().z_mm >= bare_lab.rig.config.table.paper_z_mm + 8.0
    folder = bare_lab.session
    events = [line["event"] for line in read_lines(folder / "journal.jsonl")]
    # Where the last message of a step does not fit, the journal has no word for its end either: begun, not done.
    assert events.count("begin") == events.count("done") + 1
    assert events.count("void") <= 1
    assert len(bare_lab.state.cut) + len(bare_lab.state.running) == 1
    assert len(list(folder.glob("*.part"))) == 1, "the evidence is kept"

    disk.full_after = None
    bare_lab.run()
    assert len(list(Recording(folder).captures())) == 1
