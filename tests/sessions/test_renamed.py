"""A session under another name is the same session, and what is no session is named as what it is."""

from __future__ import annotations

import shutil

import pytest

from brushloop.sessions.errors import InputError
from brushloop.sessions.events import StepKind
from brushloop.sessions.export import export
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.repair import repair_session
from brushloop.sessions.show import Summary, details, summaries
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session


@pytest.fixture
def copy(make, store, tmp_path):
    """`elsewhere/s1`, a copy of the closed session `2026-01-02-grid-01`."""
    make.collect(store)
    store.close()
    store.release()
    return shutil.copytree(store.folder, tmp_path / "elsewhere" / "s1")


def test_a_renamed_session_is_sound_and_every_command_finds_its_recording(make, copy, tmp_path):
    before = make.tree(copy)
    assert verify_session(copy).sound
    assert repair_session(copy, lambda: 0).did == []
    assert Recording(copy).strokes() == 2
    assert details(copy).file == "2026-01-02-grid-01.mcap"
    assert list(summaries(copy.parent)) == [Summary("s1", "closed", "loopback rig", 2, "2026-01-02-grid-01.mcap")]
    export(copy, tmp_path / "exported", "png")
    assert (tmp_path / "exported" / "strokes.csv").is_file()
    assert make.tree(copy) == before


@pytest.mark.parametrize("damage", ["a step", "the journal", "all but the recording", "the recording"])
def test_damage_in_a_renamed_session_is_found_and_repaired(make, copy, damage):
    journal, recording = copy / JOURNAL_NAME, copy / "2026-01-02-grid-01.mcap"
    if damage == "a step":
        next(copy.glob("*-capture-*.mcap")).unlink()
    if damage == "the journal":
        journal.write_bytes(b"{oops\n" + b"".join(journal.read_bytes().splitlines(keepends=True)[:-1]))
    if damage == "all but the recording":
        for path in [journal, *copy.glob("0*.mcap*")]:
            path.unlink()
        recording.write_bytes(recording.read_bytes()[:-40])
    if damage == "the recording":
        recording.write_bytes(recording.read_bytes()[:500])
    assert not verify_session(copy).sound
    repair_session(copy, make.clock())
    assert verify_session(copy).sound
    assert (Recording(copy).path, Recording(copy).strokes()) == (recording, 2)


def test_a_recording_that_was_renamed_with_its_folder_is_sound(copy):
    (copy / "2026-01-02-grid-01.mcap").rename(copy / "s1.mcap")
    assert verify_session(copy).sound
    assert details(copy).file == "s1.mcap"


def test_an_open_session_may_be_renamed(make, store, tmp_path):
    make.collect(store)
    store.release()
    renamed = store.folder.rename(tmp_path / "s1")
    assert verify_session(renamed).sound
    assert details(renamed).state == "open"
    resumed = SessionStore(renamed, None, make.clock())
    assert resumed.close() == renamed / "s1.mcap"
    resumed.release()
    assert verify_session(renamed).sound


LOOKS = [Recording, details, verify_session, lambda path: repair_session(path, lambda: 0)]


@pytest.mark.parametrize("look", LOOKS)
def test_an_unfinished_file_is_named_as_one(make, store, look):
    store.begin("k", StepKind.PRESS, patch=0).writer.abandon()
    (part,) = store.folder.glob("*.part")
    before = make.tree(store.folder)
    with pytest.raises(InputError) as refused:
        look(part)
    assert str(refused.value) == (
        f"{part}: was never finished, because a step or a merge was cut: it is kept as evidence and is not a "
        "recording. "
        f"Give the session's folder, {store.folder}"
    )
    assert refused.value.exit_code == 2
    assert make.tree(store.folder) == before


@pytest.mark.parametrize("look", LOOKS)
def test_a_folder_that_is_no_session_is_named_as_what_it_is(make, store, tmp_path, look):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"it holds neither journal\.jsonl nor a recording empty\.mcap"):
        look(tmp_path / "empty")
    with pytest.raises(InputError, match=rf"is not a session but holds 1 of them: give one, such as {store.folder}"):
        look(tmp_path)


def test_a_session_that_lost_its_merged_file_is_sent_to_repair(make, store):
    make.collect(store)
    store.close()
    store.release()
    (store.folder / f"{store.folder.name}.mcap").unlink()
    with pytest.raises(InputError, match=f"has lost its recording .*`brushloop sessions repair {store.folder}` makes"):
        Recording(store.folder)
    repair_session(store.folder, make.clock())
    assert Recording(store.folder).strokes() == 2
