"""What belongs to another session is told as such, and is never evidence about the strokes of this one."""

import shutil

import pytest

from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.repair import repair_session
from brushloop.sessions.verify import verify_session

OTHER = "2026-01-03-grid-01"


def closed(make, folder, strokes, **fields):
    store = make.store(folder, session_id=folder.name, **fields)
    make.collect(store, strokes)
    store.close()
    store.release()
    return folder


@pytest.fixture
def ours(make, tmp_path):
    """A closed session of three strokes."""
    return closed(make, tmp_path / make.header.session_id, 3)


@pytest.fixture
def other(make, tmp_path):
    """A closed session of the same protocol, so that its steps have the same keys; it was stopped earlier."""
    return closed(make, tmp_path / OTHER, 1)


def told(verdict):
    return [finding.file for finding in verdict.findings if f"of another session, {OTHER!r}" in finding.what]


@pytest.mark.parametrize("steps", ["with the files of its steps", "with its merged file alone"])
def test_a_session_under_the_journal_of_another_keeps_all_its_strokes(make, ours, other, steps):
    if steps == "with its merged file alone":
        for path in ours.glob("0*.mcap"):
            path.unlink()
    final = ours / f"{ours.name}.mcap"
    before = final.read_bytes()
    shutil.copy(other / JOURNAL_NAME, ours / JOURNAL_NAME)
    assert told(verify_session(ours)) == [JOURNAL_NAME]
    report = repair_session(ours, make.clock())
    assert (report.strokes, report.lost) == (3, [])
    assert final.read_bytes() == before
    assert (verify_session(ours).sound, verify_session(ours).strokes) == (True, 3)
    assert Recording(ours).strokes() == 3
    assert (ours / f"{JOURNAL_NAME}.damaged-1").read_bytes() == (other / JOURNAL_NAME).read_bytes()


def test_the_journal_of_an_empty_session_takes_nothing_away(make, ours, tmp_path):
    store = make.store(tmp_path / OTHER, session_id=OTHER)
    store.close()
    store.release()
    shutil.copy(store.folder / JOURNAL_NAME, ours / JOURNAL_NAME)
    assert told(verify_session(ours)) == [JOURNAL_NAME]
    assert (repair_session(ours, make.clock()).lost, make.stroke_names(ours / f"{ours.name}.mcap")) == (
        [],
        ["H13-a05-r00", "H13-a05-r01", "H13-a05-r02"],
    )


def test_a_renamed_open_session_is_known_by_its_files(make, other, tmp_path):
    store = make.store(tmp_path / "monday", session_id="2026-01-01-grid-01")
    make.collect(store, 2)
    store.release()
    shutil.copy(other / JOURNAL_NAME, store.folder / JOURNAL_NAME)
    assert told(verify_session(store.folder)) == [JOURNAL_NAME]
    assert (repair_session(store.folder, make.clock()).strokes, verify_session(store.folder).sound) == (2, True)


def test_the_file_of_a_step_of_another_session_never_stands_in_for_ours(make, ours, other):
    """The step has the same key, kind and attempt there."""
    name = next(path.name for path in sorted(ours.glob("*-capture-*.mcap")))
    (ours / f"{ours.name}.mcap").unlink()
    shutil.copy(other / name, ours / name)
    assert name in told(verify_session(ours))
    repair_session(ours, make.clock())
    assert make.stroke_names(ours / f"{ours.name}.mcap") == ["H13-a05-r01", "H13-a05-r02"]


def test_a_file_of_another_session_that_the_journal_does_not_list_is_put_aside(make, ours, other):
    path = shutil.copy(next(other.glob("*-capture-*.mcap")), ours / "0099-capture-0123abcd.mcap")
    assert told(verify_session(ours)) == [path.name]
    assert repair_session(ours, make.clock()).lossless
    assert (verify_session(ours).sound, path.exists()) == (True, False)
    assert make.events(ours, "done")[-1]["file"] != path.name


def test_the_merged_file_of_another_session_is_told_and_replaced(make, ours, other):
    final = ours / f"{ours.name}.mcap"
    shutil.copy(other / f"{OTHER}.mcap", final)
    assert final.name in told(verify_session(ours))
    repair_session(ours, make.clock())
    assert (len(make.stroke_names(final)), verify_session(ours).sound) == (3, True)
