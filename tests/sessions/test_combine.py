"""Several recordings become one that reads like any other, and that says where each part came from."""

import json

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from sessions.cli import app
from sessions.errors import InputError, SessionError
from sessions.merge import PARTS_NOTE, merge_recordings
from sessions.reader import Recording
from sessions.recording.mcap_file import read_note
from sessions.recording.schemas import Source
from sessions.repair.verify import verify_session
from sessions.store import SessionStore


@pytest.fixture
def closed(make, tmp_path):
    """Makes a closed session of two strokes with this name; returns its folder."""

    def closed(name, **fields):
        header = make.header.model_copy(update={"session_id": name, **fields})
        store = SessionStore.create(tmp_path / name, header, make.snapshots, make.clock())
        make.collect(store)
        store.close()
        store.release()
        return store.folder

    return closed


def test_strokes_keep_their_names_under_their_sessions_and_their_own_photographs(make, tmp_path, closed):
    out = merge_recordings([closed("monday"), closed("tuesday")], tmp_path / "week.mcap")
    recording = Recording(out)
    captures = list(recording.captures())
    assert [capture.stroke.stroke_id for capture in captures] == [
        "monday/H13-a05-r00",
        "monday/H13-a05-r01",
        "tuesday/H13-a05-r00",
        "tuesday/H13-a05-r01",
    ]
    assert [capture.still_png for capture in captures] == [make.png(0), make.png(1)] * 2
    assert len({capture.stroke.still for capture in captures}) == 4
    assert (recording.header.session_id, recording.header.brush) == ("week", "goat")
    assert recording.attachment("rig.toml").decode() == make.snapshots["rig.toml"]
    assert verify_session(out).sound


def test_every_message_is_there_with_its_own_times(make, tmp_path, closed):
    parts = [closed("monday"), closed("tuesday")]
    out = merge_recordings(parts, tmp_path / "week.mcap")
    times = [sorted(m[2:4] for part in parts for m in make.messages(part / f"{part.name}.mcap").elements())]
    assert times == [sorted(m[2:4] for m in make.messages(out).elements())]


def test_the_file_says_what_it_was_made_of(tmp_path, closed):
    parts = [closed("monday", software="brushloop 1"), closed("tuesday", software="brushloop 2")]
    out = merge_recordings(parts, tmp_path / "week.mcap")
    with out.open("rb") as file:
        notes = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    monday, tuesday = read_note(notes[PARTS_NOTE])["parts"]
    assert (monday["file"], monday["sha256"]) == ("monday.mcap", Recording(parts[0]).sha256)
    assert (tuesday["stroke_prefix"], tuesday["still_offset"]) == ("tuesday/", 1001)
    assert tuesday["header"]["software"] == "brushloop 2"
    assert json.loads(notes["brushloop.header"]["software"]) == "brushloop 1; brushloop 2"


def test_steps_of_one_open_session_need_no_prefix(make, store, tmp_path):
    make.collect(store)
    out = merge_recordings(sorted(store.folder.glob("*-capture-*.mcap")), tmp_path / "some.mcap")
    assert make.stroke_names(out) == ["H13-a05-r00", "H13-a05-r01"]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"brush": "wolf"}, "has brush = 'wolf', but monday.mcap has 'goat'"),
        ({"source": Source.REAL}, "has source = "),
    ],
)
def test_recordings_of_different_setups_are_refused(tmp_path, closed, fields, message):
    with pytest.raises(InputError, match=message):
        merge_recordings([closed("monday"), closed("tuesday", **fields)], tmp_path / "week.mcap")
    assert not list(tmp_path.glob("*week*"))


def test_another_configuration_is_another_setup(make, tmp_path, closed, monkeypatch):
    monday = closed("monday")
    monkeypatch.setitem(make.snapshots, "rig.toml", 'name = "moved"\n')
    with pytest.raises(InputError, match=r"was recorded with another rig\.toml"):
        merge_recordings([monday, closed("tuesday")], tmp_path / "week.mcap")


def test_a_stroke_that_is_there_twice_is_refused(tmp_path, closed):
    monday = closed("monday")
    segment = next(monday.glob("*-capture-*.mcap"))
    with pytest.raises(InputError, match="holds stroke H13-a05-r00 of monday, as does"):
        merge_recordings([monday, segment], tmp_path / "week.mcap")


def test_the_same_recording_twice_is_refused_whatever_it_is_called(tmp_path, closed):
    monday = closed("monday")
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((monday / "monday.mcap").read_bytes())
    for again in (monday, monday / "monday.mcap", copy):
        with pytest.raises(InputError, match=r"is, or holds, the same recording as .*/monday\.mcap") as caught:
            merge_recordings([monday, again], tmp_path / "week.mcap")
        assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*week*"))


def test_a_recording_is_refused_beside_a_file_that_it_was_merged_into(make, tmp_path, closed):
    monday, tuesday = closed("monday"), closed("tuesday")
    week = merge_recordings([monday, tuesday], tmp_path / "week.mcap")
    with pytest.raises(InputError, match=r"monday\.mcap: is, or holds, the same recording as .*/week\.mcap"):
        merge_recordings([week, monday], tmp_path / "month.mcap")
    with pytest.raises(InputError, match=r"holds stroke H13-a05-r01 of tuesday, as does .*/week\.mcap"):
        merge_recordings([week, sorted(tuesday.glob("*-capture-*.mcap"))[1]], tmp_path / "month.mcap")


def test_a_step_of_no_stroke_is_refused_twice_as_well(tmp_path, closed):
    board = next(closed("monday").glob("*-board-*.mcap"))
    with pytest.raises(InputError, match="the same recording"):
        merge_recordings([board, board], tmp_path / "boards.mcap")


def test_an_existing_file_is_never_written_over(tmp_path, closed):
    out = tmp_path / "week.mcap"
    out.write_bytes(b"precious")
    with pytest.raises(InputError, match="never overwritten"):
        merge_recordings([closed("monday"), closed("tuesday")], out)
    assert out.read_bytes() == b"precious"


@pytest.mark.parametrize("name", ["week", "a b.mcap", ".mcap"])
def test_a_name_that_is_no_sessions_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"ends in \.mcap"):
        merge_recordings([tmp_path, tmp_path], tmp_path / name)


def test_a_disk_that_fails_leaves_nothing_half_written(tmp_path, closed, monkeypatch):
    parts = [closed("monday"), closed("tuesday")]

    def fail(_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(SessionError, match="Input/output error"):
        merge_recordings(parts, tmp_path / "week.mcap")
    assert not list(tmp_path.glob("*week*"))


def test_the_command(tmp_path, closed):
    out = tmp_path / "week.mcap"
    ran = CliRunner().invoke(app, ["merge", str(out), str(closed("monday")), str(closed("tuesday"))])
    assert (ran.exit_code, ran.output) == (0, f"Merged into {out}\n")
