"""Every damage by name: what verify tells, what repair gives back, and how the session goes on afterwards."""

import itertools
import shutil
from dataclasses import dataclass, field

import pytest
from mcap.reader import make_reader

from brushloop.sessions import mcap_writer
from brushloop.sessions import repair as repairs
from brushloop.sessions.errors import DiskFull, SessionDamaged, SessionError
from brushloop.sessions.events import StepKind
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.show import Summary, details, summaries
from brushloop.sessions.verify import verify_session
from tests.command import brushloop
from tests.journal_lines import read_lines
from tests.sessions.conftest import BOARD, no_space

ID, OTHER = "2026-01-02-grid-01", "2026-01-03-grid-01"
BOTH = ("H13-a05-r00", "H13-a05-r01")


def file_of(folder, key):
    [line] = [line for line in read_lines(folder / JOURNAL_NAME) if line["event"] == "done" and line["key"] == key]
    return folder / line["file"]


def cut(path, chunk=1):
    """Cut a finished file before one of its chunks; an unfinished one is emptied."""
    data = path.read_bytes()
    path.write_bytes(b"" if path.suffix == ".part" else data[: chunks(path)[chunk].chunk_start_offset])


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def flip_index(path):
    flip(path, path.stat().st_size - 40)


def cut_index(path):
    path.write_bytes(path.read_bytes()[:-40])


def keep_lines(folder, keep):
    journal = folder / JOURNAL_NAME
    journal.write_bytes(b"".join(keep(journal.read_bytes().splitlines(keepends=True))))


def forget_from(folder, event, key):
    """Drop the journal's lines from this event of a step on; returns the step's file."""
    path = file_of(folder, key)
    words = f'"{event}"'.encode(), path.name.encode()
    keep_lines(folder, lambda lines: itertools.takewhile(lambda line: not all(word in line for word in words), lines))
    return path


def chunks(path):
    with path.open("rb") as file:
        return make_reader(file).get_summary().chunk_indexes


@dataclass
class Case:
    """What is done to a session, part of what verify says, what repair reports as lost, and the strokes that remain."""

    damage: object
    """Called with the folder and that of another session."""
    finding: str
    lost: list = field(default_factory=list)
    strokes: tuple = BOTH


def end_of_press(folder, _):
    """Neither the journal nor the file tells the end of the step."""
    path = forget_from(folder, "done", "H13-a05-r01 press")
    flip(path, chunks(path)[-1].chunk_start_offset + 60)


def configuration(folder, _):
    (folder / "rig.toml").write_text('name = "another"\n')
    (folder / "protocol.toml").unlink()


def steps_of_closed(folder, _):
    for stroke in BOTH:
        cut(file_of(folder, f"{stroke} capture"))
    file_of(folder, "board").unlink()


def steps_and_merged(folder, _):
    for path in folder.glob("*-capture-*.mcap"):
        path.write_bytes(b"")
    cut(folder / f"{ID}.mcap", -2)


def begin_of_capture(folder, _):
    """The journal does not mention the step, and its file tells only how it ended."""
    path = forget_from(folder, "begin", "H13-a05-r01 capture")
    flip(path, chunks(path)[0].chunk_start_offset + 60)


def last_step(folder, _):
    """The journal ends before the last step, whose file is gone."""
    forget_from(folder, "begin", "H13-a05-r01 capture").unlink()


def merged_of_another(folder, other):
    shutil.copy(other / f"{OTHER}.mcap", folder / f"{ID}.mcap")


def merged_alone(folder, other):
    for path in folder.glob("0*.mcap"):
        path.unlink()
    shutil.copy(other / JOURNAL_NAME, folder)


def step_of_another(folder, other):
    path = next(iter(sorted(folder.glob("*-capture-*.mcap"))))
    (folder / f"{ID}.mcap").unlink()
    shutil.copy(other / path.name, path)


def all_but_the_recording(folder, _):
    for path in [folder / JOURNAL_NAME, *folder.glob("0*.mcap*")]:
        path.unlink()
    cut_index(folder / f"{ID}.mcap")


FOREIGN = f"is of another session, '{OTHER}'"
CASES = {
    "open: a press loses poses": Case(
        lambda f, _: cut(file_of(f, "H13-a05-r00 press")),
        "(press H13-a05-r00)",
        ["messages in 0002-press-H13-a05-.mcap (press H13-a05-r00): 5 of /robot/tcp"],
    ),
    "open: a journal without its last lines": Case(
        lambda f, _: keep_lines(f, lambda lines: lines[:5]), "does not mention 0002-press-H13-a05-.mcap"
    ),
    "open: the begin of a capture": Case(begin_of_capture, "does not mention 0005-capture-H13-a05-.mcap"),
    "open: the end of a press": Case(
        end_of_press,
        "is finished, but the result of its step cannot be read",
        ["press H13-a05-r01, whose file is finished, but the result of its step cannot be read"],
    ),
    "open: the configuration": Case(configuration, "is missing, or has changed since the session was started"),
    "open: the journal of another": Case(lambda f, other: shutil.copy(other / JOURNAL_NAME, f), FOREIGN),
    "open: a merged file of another": Case(merged_of_another, FOREIGN),
    "closed: steps": Case(steps_of_closed, "(board) is missing, though the journal says it was finished"),
    "closed: steps and merged file": Case(steps_and_merged, "its index", ["capture H13-a05-r01"], BOTH[:1]),
    "closed: no merged file": Case(lambda f, _: (f / f"{ID}.mcap").unlink(), "is missing, though the journal says"),
    "closed: the merged file of another": Case(merged_of_another, "has changed since it was recorded"),
    "closed: the journal of another": Case(lambda f, other: shutil.copy(other / JOURNAL_NAME, f), FOREIGN),
    "closed: the journal of another and no steps": Case(merged_alone, FOREIGN),
    "closed: a step of another": Case(
        step_of_another, "has changed since it was recorded", ["capture H13-a05-r00"], BOTH[1:]
    ),
    "closed: a file of another that is not listed": Case(
        lambda f, other: shutil.copy(next(other.glob("*-capture-*.mcap")), f / "0099-capture-0123abcd.mcap"), FOREIGN
    ),
    "closed: the last step in journal and files": Case(last_step, "does not mention 0005-capture"),
    "renamed: the journal of another and no steps": Case(merged_alone, FOREIGN),
    "renamed: a step": Case(lambda f, _: next(f.glob("*-capture-*.mcap")).unlink(), "is missing, though"),
    "renamed: the journal": Case(
        lambda f, _: keep_lines(f, lambda lines: [b"{oops\n", *lines[:-1]]), "line 1 does not match its CRC"
    ),
    "renamed: all but the recording": Case(all_but_the_recording, "its index"),
    "renamed: the recording": Case(lambda f, _: cut(f / f"{ID}.mcap"), "its index"),
}


@pytest.fixture
def damaged(request, make, tmp_path, monkeypatch):
    """The session of a case, in small chunks, before the damage."""
    monkeypatch.setattr(mcap_writer, "CHUNK_BYTES", 256)
    state = request.param.partition(":")[0]
    folder = make.session(tmp_path / ID, closed=state != "open")
    return shutil.copytree(folder, tmp_path / "elsewhere" / "s1") if state == "renamed" else folder


@pytest.mark.parametrize(("damaged", "case"), CASES.items(), ids=CASES, indirect=["damaged"])
def test_damage_is_told_and_repaired(make, damaged, case, tmp_path, repair, resume):
    # Of the same protocol, so that its steps have the same keys; it was stopped earlier.
    other = make.session(tmp_path / OTHER, 1, closed=True, session_id=OTHER)
    case.damage(damaged, other)
    before = make.tree(damaged.parent)
    findings = verify_session(damaged).findings
    assert any(case.finding in problem for problems in findings.values() for problem in problems), findings
    assert make.tree(damaged.parent) == before, "verify changed something"
    report = repair(damaged)
    assert report.lost == case.lost
    kept = [data for data in make.tree(damaged.parent).values() if data]
    assert all(any(data in other for other in kept) for data in before.values() if data), "a damaged file is gone"
    assert repair(damaged).did == []
    verdict = verify_session(damaged)
    assert verdict.sound, verdict.findings
    final = resume(damaged).close() if verdict.state == "open" else Recording(damaged).path
    assert tuple(make.stroke_names(final)) == case.strokes


def test_a_sound_session_is_left_as_it_is(make, store, repair):
    make.collect(store)
    opened = verify_session(store.folder)
    assert (opened.sound, opened.state, opened.files, opened.strokes) == (True, "open", 5, 2)
    store.close()
    store.release()
    closed = verify_session(store.folder)
    assert (closed.sound, closed.state, closed.files, closed.messages) == (True, "closed", 6, opened.messages)
    before = make.tree(store.folder)
    report = repair(store.folder)
    assert (report.did, report.lost, report.strokes) == ([], [], 2)
    assert make.tree(store.folder) == before


def test_what_is_damaged_is_not_gone_on_with_and_the_way_out_is_named(opened, resume):
    cut(file_of(opened, "H13-a05-r00 capture"))
    store = resume(opened)
    refusals = [(store.verify, "has changed"), (store.close, "has changed")]
    keep_lines(opened, lambda lines: lines[:5])
    missing = r"does not mention 0002-press-H13-a05-\.mcap: lines are missing"
    for refused, why in [*refusals, (lambda: resume(store), missing)]:
        with pytest.raises(SessionDamaged, match=why) as caught:
            refused()
        assert caught.value.exit_code == 6
        assert caught.value.__notes__[-1] == f"Try `brushloop sessions repair {opened}`."


def test_after_the_repair_the_lost_step_is_done_again(make, opened, repair, resume):
    cut(file_of(opened, "H13-a05-r00 capture"))
    repair(opened)
    store = resume(opened)
    assert set(store.state.done) == {"board", "H13-a05-r00 press", "H13-a05-r01 press", "H13-a05-r01 capture"}
    make.take(store, "H13-a05-r00 capture", [make.still(0), make.stroke(0)], make.captured("H13-a05-r00", 0))
    assert make.events(opened, "begin")[-1]["attempt"] == 2
    assert sorted(make.stroke_names(store.close())) == list(BOTH)


def test_a_photograph_lost_with_its_sheet_gone_has_the_stroke_pressed_again(make, store, repair, resume):
    make.collect(store)
    store.fresh_sheet()
    store.release()
    cut(file_of(store.folder, "H13-a05-r00 capture"))
    repair(store.folder)
    assert set(resume(store.folder).state.done) == {"board", "H13-a05-r01 press", "H13-a05-r01 capture"}


def test_a_rebuilt_journal_is_the_one_that_was(make, opened, repair, resume):
    def lines():
        return [line for line in read_lines(opened / JOURNAL_NAME) if line["event"] in ("begin", "done")]

    before = lines()
    (opened / JOURNAL_NAME).unlink()
    repair(opened)
    assert sorted(lines(), key=str) == sorted(before, key=str)
    store = resume(opened)
    assert (store.header, store.state.used_patches) == (make.header, {(0, 0), (0, 1), (0, 2)})


def test_the_set_up_of_a_sheet_is_rebuilt_though_it_was_done_again_for_the_next(make, opened, repair, resume):
    store = resume(opened)
    store.fresh_sheet()
    make.take(store, "board", [make.still(1001)], BOARD)
    store.release()
    (opened / JOURNAL_NAME).unlink()
    repair(opened)
    assert [step.attempt for step in resume(opened).state.files.values() if step.key == "board"] == [1, 2]


def test_a_stroke_that_stands_twice_in_a_lone_recording_comes_back_once(make, tmp_path, repair):
    path = make.record(tmp_path / "a.mcap", *make.strokes(2), make.still(1), make.stroke(1))
    cut_index(path)
    repair(path)
    assert tuple(make.stroke_names(path)) == BOTH


def test_an_attempt_that_was_done_again_since_is_not_given_back_twice(make, opened, repair, resume):
    keep_lines(opened, lambda lines: lines[:-1])
    store = resume(opened)
    make.take(store, "H13-a05-r01 capture", [make.still(1), make.stroke(1)], make.captured("H13-a05-r01", 1))
    store.release()
    assert repair(opened).did == []
    assert tuple(make.stroke_names(resume(opened).close())) == BOTH


def test_where_nobody_knows_which_patch_was_pressed_the_sheet_is_not_used_again(make, opened, repair, resume):
    keep_lines(opened, lambda lines: [line for line in lines if b'"file":"0001-press' not in line])
    cut(opened / "0001-press-H13-a05-.mcap.part")
    assert "nothing more is pressed on sheet 1; continue with a fresh sheet and --sheet 2" in repair(opened).lost[1]
    store = resume(opened)
    with pytest.raises(SessionError, match="run the same command with --sheet 2"):
        store.begin("H15-a05", StepKind.PRESS, patches=(7,))
    store.fresh_sheet()
    make.perform(store, "H15-a05", 0)
    store.release()
    assert verify_session(opened).sound


def test_a_repair_that_was_cut_short_comes_to_the_same_end(make, opened, repair, resume, monkeypatch):
    cut(file_of(opened, "H13-a05-r00 press"))
    cut_index(file_of(opened, "H13-a05-r01 capture"))
    with monkeypatch.context() as killed:
        killed.setattr(repairs, "fsync_folder", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            repair(opened)
    repair(opened)
    assert verify_session(opened).sound
    assert tuple(make.stroke_names(resume(opened).close())) == BOTH


def test_a_full_disk_leaves_the_damaged_file_with_its_name(opened, repair, monkeypatch):
    path = file_of(opened, "H13-a05-r00 capture")
    cut_index(path)
    data = path.read_bytes()

    with monkeypatch.context() as disk:
        disk.setattr("os.fsync", no_space)
        with pytest.raises(DiskFull, match="No space left"):
            repair(opened)
    assert path.read_bytes() == data
    assert not repair(opened).lost


def test_nothing_to_rebuild_from_is_reported(tmp_path, repair):
    (tmp_path / JOURNAL_NAME).write_bytes(b"\x00" * 50)
    with pytest.raises(SessionDamaged, match="no file holds its header"):
        repair(tmp_path)


@pytest.mark.parametrize(
    ("damage", "code", "message"),
    [(None, 0, "nothing was changed"), (flip_index, 0, "nothing was lost"), (cut, 3, "lost: capture H13-a05-r00")],
)
def test_the_exit_code_distinguishes_lossless_from_lossy(opened, damage, code, message):
    path = file_of(opened, "H13-a05-r00 capture")
    if damage:
        damage(path)
        ran = brushloop("sessions", "verify", opened)
        assert (ran.returncode, f"damaged: {path.name}: (capture H13-a05-r00) " in ran.stdout) == (6, True)
    ran = brushloop("sessions", "repair", opened)
    assert (ran.returncode, message in ran.stdout) == (code, True), ran.stdout
    ran = brushloop("sessions", "verify", opened)
    assert (ran.returncode, f"{ID} (open) is sound: " in ran.stdout) == (0, True)


def test_close_writes_the_merged_file_of_a_session_left_open(make, opened):
    assert brushloop("sessions", "close", opened).returncode == 0
    assert tuple(make.stroke_names(opened / f"{ID}.mcap")) == BOTH
    assert "is closed" in brushloop("sessions", "close", opened).stderr


def test_what_is_wrong_within_a_message_is_damage_though_every_crc_holds(make, store, tmp_path):
    make.take(store, "a", [make.still(0, b"no image"), make.stroke(0)], make.captured("", 0))
    [[problem]] = verify_session(store.folder).findings.values()
    assert problem.endswith("the image 0 on /camera/still is not a complete PNG or JPEG image")
    findings = verify_session(make.record(tmp_path / "a.mcap", make.still(1), make.stroke(2))).findings
    assert findings == {"a.mcap": ["stroke H13-a05-r02 refers to photograph 2, which is missing"]}


def test_a_session_may_be_renamed_open_and_closed(opened, resume, repair, tmp_path):
    renamed = opened.rename(tmp_path / "elsewhere")
    assert (verify_session(renamed).sound, details(renamed).state) == (True, "open")
    store = resume(renamed)
    assert store.close() == renamed / f"{ID}.mcap"
    store.release()
    closed = renamed.rename(tmp_path / "s1")
    assert verify_session(closed).sound
    assert repair(closed).did == []
    assert list(summaries(tmp_path)) == [Summary("s1", "closed", "loopback rig", 2, f"{ID}.mcap")]
