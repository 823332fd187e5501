"""Repair, case by case: what it does, what it says, and how the session goes on afterwards."""

import errno
import shutil

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from brushloop.sessions import mcap_writer
from brushloop.sessions import repair as repairs
from brushloop.sessions.cli import app
from brushloop.sessions.errors import DiskFull, InputError, SessionDamaged, SessionError, SessionLocked
from brushloop.sessions.events import StepKind
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Topic
from brushloop.sessions.repair import repair_session
from brushloop.sessions.show import details
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session
from tests.journal_lines import read_lines


@pytest.fixture
def folder(make, store):
    """An open session of two strokes, released."""
    make.collect(store)
    store.release()
    return store.folder


@pytest.fixture
def closed(make, store):
    """A closed session of two strokes, released."""
    make.collect(store)
    store.close()
    store.release()
    return store.folder


@pytest.fixture
def repair(make):
    return lambda folder: repair_session(folder, make.clock())


@pytest.fixture
def go_on(make):
    """Opens the session as the next process would; released at the end."""
    opened = []

    def go_on(folder):
        opened.append(SessionStore(folder, None, make.clock()))
        return opened[-1]

    yield go_on
    for store in opened:
        store.release()


def cut(path, share):
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def file_of(folder, key):
    [line] = [line for line in read_lines(folder / JOURNAL_NAME) if line["event"] == "done" and line["key"] == key]
    return folder / line["file"]


def test_a_sound_session_is_left_as_it_is(make, folder, repair):
    before = {name: data for name, data in make.tree(folder).items() if name != ".lock"}
    report = repair(folder)
    assert (report.did, report.lost, report.strokes) == ([], [], 2)
    assert {name: data for name, data in make.tree(folder).items() if name != ".lock"} == before


def test_a_damaged_step_is_refused_with_the_way_out(folder, go_on):
    cut(file_of(folder, "H13-a05-r00 capture"), 0.3)
    store = go_on(folder)
    for refused in (store.verify, store.close):
        with pytest.raises(SessionDamaged, match="has changed") as caught:
            refused()
        assert caught.value.exit_code == 6
        assert caught.value.__notes__[-1] == f"Try `brushloop sessions repair {folder}`."


def test_after_the_repair_resume_and_close_work(make, folder, repair, go_on):
    damaged = file_of(folder, "H13-a05-r00 capture")
    cut(damaged, 0.3)
    report = repair(folder)
    assert report.lost == ["capture H13-a05-r00; it is done again when the session goes on"]
    assert (damaged.exists(), damaged.with_name(f"{damaged.name}.damaged-1").exists()) == (False, True)

    store = go_on(folder)
    assert set(store.state.done) == {"board", "H13-a05-r00 press", "H13-a05-r01 press", "H13-a05-r01 capture"}
    store.verify()
    make.take(store, "H13-a05-r00 capture", [make.still(0), make.stroke(0)], make.captured("H13-a05-r00", 0))
    assert make.events(folder, "begin")[-1]["attempt"] == 2
    assert sorted(make.stroke_names(store.close())) == ["H13-a05-r00", "H13-a05-r01"]


def test_a_photograph_lost_with_its_sheet_gone_has_the_stroke_pressed_again(make, store, repair, go_on):
    make.collect(store)
    store.fresh_sheet()
    store.release()
    cut(file_of(store.folder, "H13-a05-r00 capture"), 0.3)
    repair(store.folder)
    assert set(go_on(store.folder).state.done) == {"board", "H13-a05-r01 press", "H13-a05-r01 capture"}


def test_a_press_that_lost_some_poses_stays_done_and_reports_the_gap(make, folder, repair, go_on):
    cut(file_of(folder, "H13-a05-r00 press"), 0.3)
    report = repair(folder)
    assert report.lost == ["messages in 0002-press-H13-a05-.mcap (press H13-a05-r00): 1 of /step, 5 of /robot/tcp"]
    final = go_on(folder).close()
    assert make.stroke_names(final) == ["H13-a05-r00", "H13-a05-r01"]
    [note] = [note for note in verify_session(folder).notes if "missing" in note]
    assert "5 of /robot/tcp" in note


def test_a_cut_index_costs_nothing(make, folder, repair, go_on):
    path = file_of(folder, "H13-a05-r00 capture")
    path.write_bytes(path.read_bytes()[:-40])
    report = repair(folder)
    assert report.lossless
    assert "again whole" in report.did[0]
    assert make.stroke_names(go_on(folder).close()) == ["H13-a05-r00", "H13-a05-r01"]


def test_a_readable_file_of_another_step_is_not_taken_for_this_one(make, folder, repair):
    shutil.copy(file_of(folder, "H13-a05-r01 capture"), file_of(folder, "H13-a05-r00 capture"))
    assert repair(folder).lost == ["capture H13-a05-r00; it is done again when the session goes on"]


def test_a_journal_that_is_gone_is_rebuilt_from_the_files(make, folder, repair, go_on):
    before = [line for line in read_lines(folder / JOURNAL_NAME) if line["event"] in ("begin", "done")]
    (folder / JOURNAL_NAME).unlink()
    repair(folder)
    store = go_on(folder)
    assert store.header == make.header
    assert store.state.used_patches == {(0, 0), (0, 1), (0, 2)}
    after = [line for line in read_lines(folder / JOURNAL_NAME) if line["event"] in ("begin", "done")]
    assert sorted(after, key=str) == sorted(before, key=str)


def test_a_journal_without_its_last_lines_is_refused_until_repaired(make, folder, repair, go_on):
    journal = folder / JOURNAL_NAME
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:5]))
    with pytest.raises(SessionDamaged, match=r"does not mention 0002-press-H13-a05-\.mcap: lines are missing"):
        go_on(folder)
    assert repair(folder).lossless
    assert make.stroke_names(go_on(folder).close()) == ["H13-a05-r00", "H13-a05-r01"]


def test_a_step_finished_but_not_journalled_is_given_back(make, folder, repair, go_on):
    journal = folder / JOURNAL_NAME
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:-1]))
    assert repair(folder).lossless
    assert repair(folder).did == []
    assert make.stroke_names(go_on(folder).close()) == ["H13-a05-r00", "H13-a05-r01"]


@pytest.mark.parametrize(("kind", "lossless"), [("capture", True), ("press", False)])
def test_a_step_whose_end_neither_journal_nor_file_tells_is_not_passed_over(
    make, folder, repair, go_on, kind, lossless
):
    path = file_of(folder, f"H13-a05-r01 {kind}")
    lines = (folder / JOURNAL_NAME).read_bytes().splitlines(keepends=True)
    done = next(n for n, line in enumerate(lines) if b'"done"' in line and path.name.encode() in line)
    (folder / JOURNAL_NAME).write_bytes(b"".join(lines[:done]))
    data = bytearray(path.read_bytes())
    data[data.index(b"brushloop.done") + 40] ^= 1
    path.write_bytes(data)
    assert not verify_session(folder).sound
    report = repair(folder)
    assert report.lossless == lossless
    assert lossless or "press H13-a05-r01" in report.lost[0]
    assert verify_session(folder).sound
    assert make.stroke_names(go_on(folder).close()) == ["H13-a05-r00", "H13-a05-r01"]


def test_an_attempt_that_was_done_again_since_is_not_given_back_twice(make, folder, repair, go_on):
    journal = folder / JOURNAL_NAME
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:-1]))
    store = go_on(folder)
    make.take(store, "H13-a05-r01 capture", [make.still(1), make.stroke(1)], make.captured("H13-a05-r01", 1))
    store.release()
    assert repair(folder).did == []
    assert make.stroke_names(go_on(folder).close()) == ["H13-a05-r00", "H13-a05-r01"]


def test_where_nobody_knows_which_cell_was_pressed_the_sheet_is_not_used_again(make, folder, repair, go_on):
    journal = folder / JOURNAL_NAME
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(line for line in lines if b'"file":"0001-press' not in line))
    cut(folder / "0001-press-H13-a05-.mcap.part", 0.1)
    report = repair(folder)
    assert "nothing more is pressed on sheet 1; go on with a fresh one, --sheet 2" in report.lost[1]
    store = go_on(folder)
    with pytest.raises(SessionError, match="run the same command with --sheet 2"):
        store.begin("H15-a05", StepKind.PRESS, patch=7)
    store.fresh_sheet()
    make.perform(store, "H15-a05", patch=0)
    store.release()
    assert verify_session(folder).sound


def test_a_closed_session_whose_steps_are_damaged_still_has_it_all(make, closed, repair):
    for key in ("H13-a05-r00 capture", "H13-a05-r01 capture"):
        cut(file_of(closed, key), 0.3)
    file_of(closed, "board").unlink()
    report = repair(closed)
    assert (report.lossless, report.strokes) == (True, 2)
    assert verify_session(closed).sound


def test_where_steps_and_merged_file_are_damaged_the_better_one_is_taken(make, store, repair, monkeypatch):
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 256)
    make.collect(store)
    final, closed = store.close(), store.folder
    store.release()
    for path in closed.glob("*-capture-*.mcap"):
        path.write_bytes(b"")
    with final.open("rb") as file:
        last_stroke = make_reader(file).get_summary().chunk_indexes[-2]
    final.write_bytes(final.read_bytes()[: last_stroke.chunk_start_offset])
    report = repair(closed)
    assert not report.lossless
    assert make.stroke_names(final) == ["H13-a05-r00"]
    assert verify_session(closed).sound


def test_an_import_keeps_every_stroke_whose_photograph_is_whole(make, photos, out, run, repair, monkeypatch):
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 256)
    asked = {"px_per_mm": "10", "depth_mm": "13", "tilt_deg": "5", "start_x_px": "1", "start_y_px": "1"}
    rows = [{"file": f"{n}.png"} | asked for n in range(5)]
    make.photographs(photos, *rows)
    final = run()
    cut(final, 0.3)
    report = repair(out)
    kept = [capture.still_png for capture in Recording(out).captures()]
    assert 0 < len(kept) < 5
    assert kept == [make.png(n) for n in range(len(kept))]
    assert (report.strokes, report.lossless) == (len(kept), False)


def test_a_changed_configuration_comes_back_from_the_journal(make, folder, repair):
    (folder / "rig.toml").write_text('name = "another"\n')
    (folder / "protocol.toml").unlink()
    assert {finding.file for finding in verify_session(folder).findings} == {"rig.toml", "protocol.toml"}
    assert repair(folder).lossless
    assert {name: (folder / name).read_text() for name in make.snapshots} == make.snapshots
    assert (folder / "rig.toml.damaged-1").read_text() == 'name = "another"\n'


def test_a_repair_that_was_cut_short_comes_to_the_same_end(make, folder, repair, go_on, monkeypatch):
    cut(file_of(folder, "H13-a05-r00 press"), 0.3)
    path = file_of(folder, "H13-a05-r01 capture")
    path.write_bytes(path.read_bytes()[:-40])
    with monkeypatch.context() as killed:
        killed.setattr(repairs, "fsync_folder", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            repair(folder)
    repair(folder)
    assert verify_session(folder).sound
    assert make.stroke_names(go_on(folder).close()) == ["H13-a05-r00", "H13-a05-r01"]


def test_a_session_that_another_process_has_is_not_repaired(make, store, repair):
    make.collect(store)
    before = make.tree(store.folder)
    with pytest.raises(SessionLocked):
        repair(store.folder)
    assert make.tree(store.folder) == before


def test_a_full_disk_leaves_the_damaged_file_with_its_name(make, folder, repair, monkeypatch):
    path = file_of(folder, "H13-a05-r00 capture")
    path.write_bytes(path.read_bytes()[:-40])
    data = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr("os.fsync", full)
        with pytest.raises(DiskFull, match="No space left"):
            repair(folder)
    assert path.read_bytes() == data
    assert repair(folder).lossless


def test_a_folder_that_may_not_be_written_is_a_session_error(folder, repair, read_only_disk):
    cut(file_of(folder, "H13-a05-r00 capture"), 0.3)
    read_only_disk()
    with pytest.raises(SessionError, match="Read-only file system"):
        repair(folder)


def test_nothing_to_rebuild_from_is_reported(tmp_path, repair):
    (tmp_path / JOURNAL_NAME).write_bytes(b"\x00" * 50)
    with pytest.raises(SessionDamaged, match="no file holds its header"):
        repair(tmp_path)
    with pytest.raises(InputError, match="no such session"):
        repair_session(tmp_path.parent / "gone", int)


@pytest.mark.parametrize(
    ("damage", "code", "message"),
    [(None, 0, "nothing was changed"), (40, 0, "nothing was lost"), (6000, 3, "lost: capture H13-a05-r00")],
)
def test_the_exit_code_distinguishes_lossless_from_lossy(folder, damage, code, message):
    path = file_of(folder, "H13-a05-r00 capture")
    if damage:
        path.write_bytes(path.read_bytes()[:-damage])
        ran = CliRunner().invoke(app, ["verify", str(folder)])
        assert ran.exit_code == 6
        assert f"damaged: {path.name}: (capture H13-a05-r00) " in ran.output
    ran = CliRunner().invoke(app, ["repair", str(folder)])
    assert (ran.exit_code, message in ran.output) == (code, True), ran.output
    assert CliRunner().invoke(app, ["verify", str(folder)]).exit_code == 0


def test_close_writes_the_merged_file_of_a_session_left_open(make, folder):
    ran = CliRunner().invoke(app, ["close", str(folder)])
    assert ran.exit_code == 0
    assert make.stroke_names(folder / f"{folder.name}.mcap") == ["H13-a05-r00", "H13-a05-r01"]
    again = CliRunner().invoke(app, ["close", str(folder)])
    assert isinstance(again.exception, InputError)
    assert "is closed" in str(again.exception)


def test_close_refuses_while_another_process_has_the_session(make, store):
    make.collect(store)
    ran = CliRunner().invoke(app, ["close", str(store.folder)])
    assert isinstance(ran.exception, SessionLocked)


def test_one_flipped_byte_of_a_lone_recording_costs_one_stroke(make, tmp_path, repair):
    store = make.store(tmp_path / make.header.session_id)
    make.collect(store, 6)
    path = tmp_path / "alone" / "lone.mcap"
    path.parent.mkdir()
    shutil.copy(store.close(), path)
    store.release()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    [stroke] = [number for number, channel in summary.channels.items() if channel.topic == Topic.STROKE]
    chunk = [chunk for chunk in summary.chunk_indexes if stroke in chunk.message_index_offsets][2]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    path.write_bytes(data)
    report = repair(path)
    assert make.stroke_names(path) == [f"H13-a05-r{number:02d}" for number in (0, 1, 3, 4, 5)]
    assert report.lost[0] == "strokes that cannot be read: 1"


@pytest.mark.parametrize(
    ("event", "field"),
    [
        ("open", "header"),
        ("begin", "attempt"),
        ("begin", "kind"),
        ("done", "file"),
        ("done", "result"),
        ("void", "attempt"),
        ("sheet", "sheet"),
    ],
)
def test_a_line_without_a_field_is_damage_for_every_command(make, folder, repair, event, field):
    opened = SessionStore(folder, None, int)
    opened.fresh_sheet()
    opened.release()

    def without(line):
        return {name: value for name, value in line.items() if line["event"] != event or name != field}

    make.rewrite_journal(folder, without)
    message = f"'{field}' of event '{event}' is missing"
    with pytest.raises(SessionDamaged, match=message):
        details(folder)
    assert message in str(verify_session(folder).findings)
    repair(folder)
    assert verify_session(folder).sound
