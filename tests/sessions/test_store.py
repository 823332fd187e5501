"""A session's folder: one process at a time, resumed from what the journal says, closed with every segment once."""

import datetime as dt
import json
import threading

import pytest
from mcap.reader import make_reader

from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, SessionLocked
from brushloop.sessions.events import PressResult, StepKind
from brushloop.sessions.journal import JOURNAL_NAME, Journal
from brushloop.sessions.mcap_file import open_mcap, scan_sound
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore, next_session_id, open_sessions


@pytest.fixture
def resume(make):
    """Opens a session again, as the next process would."""
    opened = []

    def again(store):
        store.release()
        opened.append(SessionStore(store.folder, None, make.clock()))
        return opened[-1]

    yield again
    for store in opened:
        store.release()


def test_an_existing_folder_is_refused_and_left_as_it_is(make, tmp_path):
    (tmp_path / "s").mkdir()
    with pytest.raises(InputError, match="exists already") as caught:
        make.store(tmp_path / "s")
    assert caught.value.exit_code == 2
    assert list((tmp_path / "s").iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_session_error(make, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SessionError, match="cannot create"):
        make.store(tmp_path / "file" / "s")


def test_a_folder_without_journal_is_refused_and_left_as_it_is(make, tmp_path):
    with pytest.raises(InputError, match="holds no journal"):
        SessionStore(tmp_path, None, make.clock())
    with pytest.raises(InputError):
        SessionStore(tmp_path / "gone", None, make.clock())
    assert list(tmp_path.iterdir()) == []


def test_a_second_store_on_the_folder_is_locked_out(make, store):
    with pytest.raises(SessionLocked) as caught:
        SessionStore(store.folder, None, make.clock())
    assert caught.value.exit_code == 2


def test_a_lock_is_given_back_from_any_thread(make, store, resume):
    thread = threading.Thread(target=store.release)
    thread.start()
    thread.join()
    assert resume(store).header == make.header


def test_attempts_cells_and_results_are_kept_across_processes(make, store, resume):
    make.perform(store, "H13-a05", patch=0)
    store.void(store.begin("H15-a05", StepKind.PRESS, patch=1), "stopped by the operator")
    second = resume(store)
    assert second.state.done["H13-a05"].result == make.captured("H13-a05", 0)
    assert second.state.used_patches == {(0, 0), (0, 1)}
    attempt = second.begin("H15-a05", StepKind.PRESS, patch=2)
    assert (attempt.begin.attempt, attempt.serial) == (2, 2)
    second.done(attempt, PressResult(press=make.press()))
    assert [line["why"] for line in make.events(store.folder, "void")] == ["stopped by the operator"]
    assert resume(second).state.attempts == {"H13-a05": 1, "H15-a05": 2}


def test_a_fresh_sheet_frees_its_cells_and_stays_fresh(make, store, resume):
    make.perform(store, "H13-a05", patch=0)
    store.fresh_sheet()
    make.perform(store, "H15-a05", patch=0)
    state = resume(store).state
    assert (state.sheet, state.used_patches) == (1, {(0, 0), (1, 0)})


def test_a_process_that_dies_after_begin_has_burnt_the_cell(make, store, resume):
    store.begin("H13-a05", StepKind.PRESS, patch=3).writer.abandon()
    second = resume(store)
    assert second.state.used_patches == {(0, 3)}
    make.perform(second, "H13-a05", patch=4)
    assert make.stroke_names(second.close()) == ["H13-a05"]


def test_a_process_that_dies_between_rename_and_done_does_the_step_again(make, store, resume):
    attempt = store.begin("H13-a05", StepKind.PRESS, patch=3)
    attempt.writer.write(make.stroke(0, stroke_id="never journalled"))
    attempt.writer.finish()
    second = resume(store)
    assert second.state.done == {}
    make.perform(second, "H13-a05", patch=4)
    assert make.stroke_names(second.close()) == ["H13-a05"]


def test_a_process_that_dies_before_closed_closes_again_with_one_copy_of_each(make, store, resume):
    for key in ("a", "b", "c"):
        make.perform(store, key)
    store.close()
    journal = store.folder / JOURNAL_NAME
    lines = journal.read_text().splitlines(keepends=True)
    assert json.loads(lines[-1])["event"] == "closed"
    journal.write_text("".join(lines[:-1]))
    with pytest.raises(InputError, match="still open"):
        Recording(store.folder)
    assert make.stroke_names(resume(store).close()) == ["a", "b", "c"]
    assert len(make.events(store.folder, "closed")) == 1


def test_the_merged_file_holds_what_the_journal_counted_and_the_configuration(make, store):
    make.perform(store, "a")
    make.perform(store, "b")
    final = store.close()
    [closed] = make.events(store.folder, "closed")
    assert closed["counts"] == scan_sound(final).counts == {"/camera/still": 2, "/stroke": 2}
    with final.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        attached = {a.name: a.data.decode() for a in reader.iter_attachments()}
        assert reader.get_summary().statistics.message_count == 4
    assert attached == make.snapshots
    recording = Recording(store.folder)
    assert recording.header == make.header
    assert recording.attachment("rig.toml").decode() == make.snapshots["rig.toml"]


def test_each_attached_file_says_what_it_is(make, tmp_path):
    snapshots = {**make.snapshots, "rig.effective.json": '{"name": "bench"}\n'}
    store = SessionStore.create(tmp_path / "monday", make.header, snapshots, make.clock())
    make.perform(store, "monday")
    final = store.close()
    store.release()
    expected = dict.fromkeys(make.snapshots, "application/toml") | {"rig.effective.json": "application/json"}
    assert {a.name: a.media_type for a in open_mcap(final).attachments()} == expected


def test_a_closed_session_is_not_opened_for_writing_again(make, store, resume):
    store.close()
    before = make.tree(store.folder)
    with pytest.raises(InputError, match="is closed"):
        resume(store)
    assert make.tree(store.folder) == before


@pytest.mark.parametrize("damage", ["flipped byte", "missing", "of another session"])
def test_a_segment_that_changed_is_named_and_nothing_is_merged(make, store, damage):
    make.perform(store, "a")
    make.perform(store, "b")
    segment = store.folder / str(make.events(store.folder, "done")[1]["file"])
    if damage == "missing":
        segment.unlink()
    elif damage == "flipped byte":
        data = bytearray(segment.read_bytes())
        data[len(data) // 2] ^= 1
        segment.write_bytes(data)
    else:
        segment.write_bytes((store.folder / str(make.events(store.folder, "done")[0]["file"])).read_bytes())
    with pytest.raises(SessionDamaged) as caught:
        store.close()
    assert caught.value.path == segment
    assert not (store.folder / f"{store.folder.name}.mcap").exists()
    assert make.events(store.folder, "closed") == []


def test_counts_that_do_not_agree_leave_the_merged_file_unnamed(make, store, resume):
    make.perform(store, "a")

    def more(line):
        return {**line, "counts": {**line["counts"], "/stroke": 2}} if line["event"] == "done" else line

    make.rewrite_journal(store.folder, more)
    with pytest.raises(SessionDamaged, match="the journal says"):
        resume(store).close()
    assert not (store.folder / f"{store.folder.name}.mcap").exists()


def test_a_session_that_died_before_its_first_line_is_not_offered_to_go_on(make, tmp_path):
    (tmp_path / "s").mkdir()
    Journal(tmp_path / "s" / JOURNAL_NAME).close()
    assert open_sessions(tmp_path) == []
    with pytest.raises(SessionDamaged, match="no `open` event"):
        SessionStore(tmp_path / "s", None, make.clock())


@pytest.mark.parametrize("opened", [{}, {"header": {"session_id": 3}}])
def test_a_header_that_cannot_be_read_is_damage_in_one_line(make, tmp_path, opened):
    journal = Journal(tmp_path / JOURNAL_NAME)
    journal.append(1, {"event": "open", **opened})
    journal.close()
    with pytest.raises(SessionDamaged, match="header") as caught:
        SessionStore(tmp_path, None, make.clock())
    assert "\n" not in str(caught.value)


def test_open_sessions_are_listed_oldest_first_without_the_closed(make, tmp_path):
    for name in ("c", "a", "b"):
        store = make.store(tmp_path / name)
        if name == "b":
            store.close()
        store.release()
    assert [folder.name for folder in open_sessions(tmp_path)] == ["a", "c"]


def test_session_ids_count_up_until_the_day_is_full(tmp_path):
    today = dt.date(2026, 11, 21)
    assert next_session_id(tmp_path, "grid", today) == "2026-11-21-grid-01"
    (tmp_path / "2026-11-21-grid-01").mkdir()
    assert next_session_id(tmp_path, "grid", today) == "2026-11-21-grid-02"
    for number in range(2, 1000):
        (tmp_path / f"2026-11-21-grid-{number:02d}").touch()
    with pytest.raises(InputError, match="999 sessions"):
        next_session_id(tmp_path, "grid", today)


def test_an_attempt_that_marks_several_cells_burns_them_all(make, store, resume):
    store.begin("check", StepKind.SELF_CHECK, patch=0, more_patches=(5, 36)).writer.abandon()
    assert store.state.used_patches == {(0, 0), (0, 5), (0, 36)}
    assert resume(store).state.used_patches == store.state.used_patches
