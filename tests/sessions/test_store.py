"""A session's folder: one process at a time, resumed from its journal, whole whatever the disk and the clock do."""

import errno
import itertools
import os
from collections import namedtuple
from dataclasses import replace

import pytest
from mcap.reader import make_reader

from brushloop.collect.engine.open_or_resume import open_sessions
from brushloop.sessions import disk
from brushloop.sessions.errors import DiskFull, InputError, SessionDamaged, SessionError, SessionLocked
from brushloop.sessions.events import PressResult, StepKind
from brushloop.sessions.journal import JOURNAL_NAME, Journal
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session
from tests.journal_lines import read_lines


def test_an_existing_folder_is_refused_and_left_as_it_is(make, tmp_path):
    (tmp_path / "s").mkdir()
    with pytest.raises(InputError, match="exists already") as caught:
        make.store(tmp_path / "s")
    assert caught.value.exit_code == 2
    assert list((tmp_path / "s").iterdir()) == []


def test_attempts_sheets_patches_and_results_are_kept_across_processes(make, store, resume):
    make.perform(store, "H13-a05", 0)
    store.void(store.begin("H15-a05", StepKind.PRESS, patches=(1, 36)), "stopped by the operator")
    second = resume(store)
    assert second.state.done["H13-a05"].result == make.captured("H13-a05", 0)
    assert second.state.used_patches == {(0, 0), (0, 1), (0, 36)}
    attempt = second.begin("H15-a05", StepKind.PRESS, patches=(2,))
    assert (attempt.begin.attempt, attempt.serial) == (2, 2)
    second.done(attempt, PressResult(press=make.press()))
    second.fresh_sheet()
    make.perform(second, "H17-a05", 0)
    state = resume(second).state
    assert state.attempts == {"H13-a05": 1, "H15-a05": 2, "H17-a05": 1}
    assert [(begin.key, why) for begin, why in state.cut] == [("H15-a05", "stopped by the operator")]
    assert state.sheet == 1, "a fresh sheet frees its patches and stays fresh"
    assert state.used_patches == {(0, 0), (0, 1), (0, 36), (0, 2), (1, 0)}


def test_the_merged_file_holds_what_the_journal_counted_and_the_configuration(make, store):
    make.perform(store, "a")
    make.perform(store, "b")
    final = store.close()
    [closed] = make.events(store.folder, "closed")
    assert (
        closed["counts"] == McapFile(final, check=True).sound().counts == {"/step": 4, "/camera/still": 2, "/stroke": 2}
    )
    with final.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        attached = {a.name: a.data.decode() for a in reader.iter_attachments()}
        assert reader.get_summary().statistics.message_count == 8
    assert attached == {"header.json": make.header.model_dump_json(), **make.snapshots}
    recording = Recording(store.folder)
    assert recording.header == make.header
    assert recording.attachment("rig.toml").decode() == make.snapshots["rig.toml"]


def test_counts_that_do_not_agree_leave_the_merged_file_unnamed(make, store, resume):
    make.perform(store, "a")
    make.rewrite_journal(store.folder, "done", counts={"/step": 2, "/camera/still": 1, "/stroke": 2})
    with pytest.raises(SessionDamaged, match="the journal says"):
        resume(store).close()
    assert not (store.folder / f"{store.folder.name}.mcap").exists()


def test_a_session_that_died_before_its_first_line_is_not_offered_to_go_on(make, tmp_path):
    (tmp_path / "s").mkdir()
    Journal(tmp_path / "s" / JOURNAL_NAME).close()
    assert open_sessions(tmp_path) == []
    with pytest.raises(SessionDamaged, match="no `open` event"):
        SessionStore(tmp_path / "s", make.clock())


Usage = namedtuple("Usage", "total used free")


def test_a_step_is_not_begun_nor_a_session_merged_where_its_files_might_not_fit(make, store, monkeypatch):
    make.perform(store, "a")
    before, free_bytes = make.tree(store.folder), 1_000_000
    with monkeypatch.context() as full:
        full.setattr(disk.shutil, "disk_usage", lambda _: Usage(10**12, 10**12 - free_bytes, free_bytes))
        with pytest.raises(DiskFull, match="the disk has 1 MB left, 84 MB are needed; make room") as caught:
            store.begin("b", StepKind.PRESS, patches=(0,))
        assert caught.value.exit_code == 4
        assert store.state.used_patches == set(), "no patch is burnt"
        free_bytes = 1000
        with pytest.raises(DiskFull):
            store.close()
    assert make.tree(store.folder) == before
    assert make.stroke_names(store.close()) == ["a"]


def test_a_read_only_folder_is_reported_in_one_line(make, store, monkeypatch):
    make.perform(store, "a")
    store.release()
    open_ = os.open

    def read_only(path, flags, *more, **options):
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return open_(path, flags, *more, **options)

    monkeypatch.setattr(os, "open", read_only)
    with pytest.raises(SessionError, match="Read-only file system"):
        SessionStore(store.folder, make.clock())
    assert verify_session(store.folder).sound, "looking needs no right to write"


def test_a_clock_that_is_set_back_reorders_nothing(make, tmp_path):
    """The strokes come out in the order in which they were made, each with its own photograph."""
    ticks = itertools.chain([make.t0_ns + 10**10] * 2, itertools.count(make.t0_ns, 1_000_000))
    store = SessionStore.create(tmp_path / "s", make.header, make.snapshots, lambda: next(ticks))
    for number in (3, 2, 1):  # each is stamped before the last one
        still, stroke = make.still(number), make.stroke(number, stroke_id=f"stroke {number}")
        early_ns = still.log_ns - 500
        earlier = replace(stroke, log_ns=early_ns, publish_ns=early_ns)
        make.take(store, f"key {number}", [still, earlier], make.captured(f"stroke {number}", number))
    final = store.close()
    store.release()
    captures = list(Recording(final).captures())
    assert [capture.stroke.stroke_id for capture in captures] == ["stroke 3", "stroke 2", "stroke 1"]
    assert [capture.still_png for capture in captures] == [make.png(3), make.png(2), make.png(1)]
    times_ns = [line["t_ns"] for line in read_lines(store.folder / JOURNAL_NAME)]
    assert times_ns != sorted(times_ns)
    assert verify_session(store.folder).sound


def test_where_the_end_of_a_step_does_not_fit_the_step_stays_open_and_its_writer_ends(make, store, monkeypatch):
    attempt = store.begin("a", StepKind.PRESS, patches=(0,), press=make.press())
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.sessions.mcap_writer.QUEUE_LIMIT", 0)
        with pytest.raises(SessionError, match="the disk does not keep up"):
            store.done(attempt, PressResult(press=make.press()))
    assert not attempt.writer._thread.is_alive()
    assert store.state.running


def test_while_one_process_has_a_session_no_other_collects_closes_or_repairs_it(make, store, repair):
    make.collect(store)
    before = make.tree(store.folder)
    for take in (lambda: SessionStore(store.folder, make.clock()), lambda: repair(store.folder)):
        with pytest.raises(SessionLocked) as caught:
            take()
        assert caught.value.exit_code == 2
    assert make.tree(store.folder) == before
    assert verify_session(store.folder).sound, "looking is allowed"


def test_a_merged_file_from_a_close_that_was_cut_is_kept_beside_the_new_one(make, store, resume):
    make.perform(store, "a")
    first = store.close().read_bytes()
    journal = store.folder / JOURNAL_NAME
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-1]))
    again = resume(store)
    make.perform(again, "b")
    assert make.stroke_names(again.close()) == ["a", "b"]
    assert (store.folder / f"{store.folder.name}.mcap.superseded-1").read_bytes() == first


def test_a_copy_that_was_kept_once_is_not_kept_again(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    kept = {disk.set_aside(path, "damaged") for _ in range(2)}
    path.write_bytes(b"other")
    assert kept == {tmp_path / "a.mcap.damaged-1"}
    assert disk.set_aside(path, "damaged").name == "a.mcap.damaged-2"
