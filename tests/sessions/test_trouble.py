"""A full disk, a folder that may not be written, a clock that is set back, a second process: each has one outcome."""

import errno
import io
import itertools
import os
import subprocess
import sys
import time
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from brushloop.sessions import disk
from brushloop.sessions.errors import DiskFull, SessionError
from brushloop.sessions.events import PressResult, StepKind
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session
from tests.journal_lines import read_lines
from tests.waiting import PATIENCE_S

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def go_on(make):
    opened = []

    def go_on(store):
        store.release()
        opened.append(SessionStore(store.folder, None, make.clock()))
        return opened[-1]

    yield go_on
    for store in opened:
        store.release()


def free(monkeypatch, free_bytes):
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda _: Usage(10**12, 10**12 - free_bytes, free_bytes))


def test_a_step_is_not_begun_where_its_files_might_not_fit(make, store, monkeypatch):
    make.perform(store, "a")
    before = make.tree(store.folder)
    free(monkeypatch, 1_000_000)
    with pytest.raises(DiskFull, match="the disk has 1 MB left, 84 MB are needed; make room") as caught:
        store.begin("b", StepKind.PRESS, patch=0)
    assert caught.value.exit_code == 4
    assert make.tree(store.folder) == before
    assert store.state.used_patches == set(), "no patch is burnt"


def test_a_session_is_not_merged_where_the_merged_file_might_not_fit(make, store, monkeypatch):
    make.perform(store, "a")
    with monkeypatch.context() as full:
        free(full, 1000)
        with pytest.raises(DiskFull):
            store.close()
    assert not (store.folder / f"{store.folder.name}.mcap").exists()
    assert make.stroke_names(store.close()) == ["a"]


def test_a_disk_that_fills_up_during_a_step_ends_the_attempt_and_nothing_finished_is_lost(
    make, store, go_on, monkeypatch
):
    """Neither the step's file nor its `void` fits; with room again, the session goes on with the next attempt."""
    make.perform(store, "a", patch=0)
    open_, write = Path.open, os.write

    class Full(io.FileIO):
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    def no_room(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def open_on_it(path, mode="r", **options):
        return io.BufferedWriter(Full(path, mode)) if mode == "xb" else open_(path, mode, **options)

    monkeypatch.setattr(Path, "open", open_on_it)
    attempt = store.begin("b", StepKind.PRESS, patch=1)
    monkeypatch.setattr(os, "write", no_room)

    def finish():
        attempt.writer.write(make.still(0, np.random.default_rng(0).bytes(500_000)))
        store.done(attempt, PressResult(press=make.press()))

    with pytest.raises(DiskFull, match="No space left on device"):
        finish()
    with pytest.raises(DiskFull, match="cannot write: No space left on device"):
        store.void(attempt, "the disk is full")
    monkeypatch.setattr(os, "write", write)
    monkeypatch.setattr(Path, "open", open_)

    again = go_on(store)
    assert set(again.state.done) == {"a"}
    assert again.state.used_patches == {(0, 0), (0, 1)}
    make.perform(again, "b", patch=2)
    assert make.stroke_names(again.close()) == ["a", "b"]
    assert verify_session(store.folder).sound


def test_a_read_only_folder_is_reported_in_one_line(make, store, read_only_disk):
    make.perform(store, "a")
    store.release()
    read_only_disk()
    with pytest.raises(SessionError, match="Read-only file system"):
        SessionStore(store.folder, None, make.clock())
    assert verify_session(store.folder).sound, "looking needs no right to write"


def test_a_folder_that_cannot_be_made_for_want_of_room_is_a_full_disk(make, tmp_path, monkeypatch):
    def no_room(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", no_room)
    with pytest.raises(DiskFull):
        make.store(tmp_path / "s")


def test_a_clock_that_is_set_back_reorders_nothing(make, tmp_path):
    """The strokes come out in the order in which they were made, each with its own photograph."""
    ticks = itertools.chain([make.t0_ns + 10**10] * 2, itertools.count(make.t0_ns, 1_000_000))
    store = SessionStore.create(tmp_path / "s", make.header, make.snapshots, lambda: next(ticks))
    for number in (3, 2, 1):  # each is stamped before the last one
        messages = [make.still(number), make.stroke(number)]
        messages[1] = make.stroke(number, stroke_id=f"stroke {number}")
        early = messages[0].log_ns - 500
        messages[1] = type(messages[1])(messages[1].topic, early, early, number, messages[1].message)
        make.take(store, f"key {number}", messages, make.captured(f"stroke {number}", number))
    final = store.close()
    store.release()
    captures = list(Recording(final).captures())
    assert [capture.stroke.stroke_id for capture in captures] == ["stroke 3", "stroke 2", "stroke 1"]
    assert [capture.still_png for capture in captures] == [make.png(3), make.png(2), make.png(1)]
    times_ns = [line["t_ns"] for line in read_lines(store.folder / JOURNAL_NAME)]
    assert times_ns != sorted(times_ns)
    assert verify_session(store.folder).sound


HOLD = """
import sys, time
from pathlib import Path
from brushloop.sessions.store import SessionStore
store = SessionStore(Path(sys.argv[1]), None, time.time_ns)
print("held", flush=True)
sys.stdin.readline()
store.release()
"""

TOUCH = """
import sys, time
from pathlib import Path
from brushloop.sessions.repair import repair_session
from brushloop.sessions.store import SessionStore
folder = Path(sys.argv[1])
for take in (lambda: SessionStore(folder, None, time.time_ns), lambda: repair_session(folder, time.time_ns)):
    try:
        take()
    except Exception as error:
        print(type(error).__name__, error.exit_code)
"""


def test_while_one_process_has_a_session_no_other_collects_closes_or_repairs_it(make, store):
    make.collect(store)
    store.release()
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, store.folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout.readline() == "held\n"
        before = make.tree(store.folder)
        other = subprocess.run(
            [sys.executable, "-c", TOUCH, store.folder], capture_output=True, text=True, check=True, timeout=PATIENCE_S
        )
        assert other.stdout.split() == ["SessionLocked", "2", "SessionLocked", "2"]
        assert make.tree(store.folder) == before
        assert verify_session(store.folder).sound, "looking is allowed"
        holder.stdin.write("\n")
        holder.stdin.flush()
        holder.wait()
    SessionStore(store.folder, None, time.time_ns).release()


def test_a_merged_file_from_a_close_that_was_cut_is_kept_beside_the_new_one(make, store, go_on):
    make.perform(store, "a")
    first = store.close().read_bytes()
    journal = store.folder / JOURNAL_NAME
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-1]))
    again = go_on(store)
    make.perform(again, "b")
    assert make.stroke_names(again.close()) == ["a", "b"]
    assert (store.folder / f"{store.folder.name}.mcap.superseded-1").read_bytes() == first


def test_where_the_file_system_has_no_links_a_copy_is_kept(tmp_path, monkeypatch):
    def no_links(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    kept = disk.set_aside(path, "damaged")
    path.write_bytes(b"other")
    assert (kept.read_bytes(), disk.set_aside(path, "damaged").name) == (b"precious", "a.mcap.damaged-2")
