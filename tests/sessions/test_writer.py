"""One segment: everything that was written is in it, and a failing disk is heard."""

import contextlib
import errno
import hashlib
import io
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader

from brushloop.sessions import mcap_writer
from brushloop.sessions.errors import SessionError
from brushloop.sessions.mcap_writer import SegmentWriter


class FullDisk(io.FileIO):
    """A file on a disk with room for `room` bytes."""

    room = 4096

    def write(self, data):
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "0001-press-abc.mcap"


@pytest.fixture
def full_disk(monkeypatch):
    open_ = Path.open

    def open_on_it(path, mode="r", **options):
        return io.BufferedWriter(FullDisk(path, mode)) if mode == "xb" else open_(path, mode, **options)

    monkeypatch.setattr(Path, "open", open_on_it)


def write_all(writer, messages, pause_s=0.0):
    for message in messages:
        writer.write(message)
        time.sleep(pause_s)


def test_counts_and_digest_tell_what_is_in_the_file(make, path):
    writer = SegmentWriter(path, make.header)
    write_all(writer, [*make.strokes(3), make.pose(41)])
    assert [p.name for p in path.parent.iterdir()] == [f"{path.name}.part"], "it has its name once it is finished"
    sha256 = writer.finish()
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert writer.counts == {"/camera/still": 3, "/stroke": 3, "/robot/tcp": 1}
    assert sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    [pose] = [key for key in make.messages(path) if key[0] == "/robot/tcp"]
    assert pose[1:4] == (41, make.t0_ns + 41, make.t0_ns + 40), "times and sequence are the device's own"


@pytest.mark.parametrize("suffix", ["", ".part"])
def test_a_recording_is_never_overwritten(make, path, suffix):
    there = path.with_name(path.name + suffix)
    there.write_bytes(b"precious")
    with pytest.raises(SessionError, match="never overwritten"):
        SegmentWriter(path, make.header)
    assert make.tree(path.parent) == {there.name: b"precious"}


def test_a_full_disk_is_heard_by_a_later_write_and_the_part_stays(make, path, full_disk):
    writer = SegmentWriter(path, make.header)
    noise = np.random.default_rng(0).bytes(9000)
    with pytest.raises(SessionError, match="cannot write: No space left on device"):
        write_all(writer, (make.still(number, noise) for number in range(1000)), pause_s=0.001)
    writer.abandon()
    assert [p.name for p in path.parent.iterdir()] == [f"{path.name}.part"]


@pytest.mark.parametrize("failing", ["fsync", "rename"])
def test_an_error_of_the_last_steps_is_a_session_error(make, path, monkeypatch, failing):
    def fail(*_):
        raise OSError(errno.EIO, "Input/output error")

    writer = SegmentWriter(path, make.header)
    monkeypatch.setattr(*((os, "fsync", fail) if failing == "fsync" else (Path, "rename", fail)))
    with pytest.raises(SessionError, match="Input/output error"):
        writer.finish()
    assert [p.name for p in path.parent.iterdir()] == [f"{path.name}.part"]


def test_a_disk_that_does_not_keep_up_is_heard(make, path, monkeypatch):
    monkeypatch.setattr(mcap_writer, "QUEUE_LIMIT", 1)
    writer = SegmentWriter(path, make.header)
    noise = np.random.default_rng(0).bytes(1_000_000)
    with pytest.raises(SessionError, match="1 messages wait: the disk does not keep up"):
        write_all(writer, (make.still(number, noise) for number in range(1000)))
    writer.abandon()


KILLED = """
import itertools, sys, time
from pathlib import Path
from brushloop.sessions.messages import pose_message
from brushloop.sessions.records import Header, Topic
from brushloop.sessions.mcap_writer import Outgoing, SegmentWriter
writer = SegmentWriter(Path(sys.argv[1]), Header(session_id="s", source="loopback rig", software="t"))
for n in itertools.count():
    t_ns = time.time_ns()
    writer.write(Outgoing(Topic.TCP, t_ns, t_ns, n, pose_message(t_ns, (0, 0, 0), (0, 0, 0, 1))))
    if n % 50 == 49:
        print(n, flush=True)
    time.sleep(0.001)
"""


def salvaged(part):
    """The messages of an unfinished file, up to where it ends."""
    found = []
    with part.open("rb") as file, contextlib.suppress(EndOfFile, struct.error):
        for record in StreamReader(file, validate_crcs=True).records:
            found += [record] if isinstance(record, Message) else []
    return found


def test_a_killed_process_loses_at_most_half_a_second(path):
    child = subprocess.Popen([sys.executable, "-c", KILLED, path], stdout=subprocess.PIPE, text=True)
    with child:
        for _ in range(25):
            child.stdout.readline()
        killed_ns = time.time_ns()
        child.kill()
    found = salvaged(path.with_name(path.name + ".part"))
    assert [message.sequence for message in found] == list(range(len(found)))
    # Flushes are 0.25 s apart; the rest is for a busy machine.
    assert (killed_ns - found[-1].log_time) / 1e9 < 0.75
