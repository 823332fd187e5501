"""A copy of a session under another name is not damaged: every command says what happened, and none changes it."""

from __future__ import annotations

import shutil

import pytest
from typer.testing import CliRunner

from brushloop.sessions.cli import app
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


@pytest.mark.parametrize("look", [Recording, details, verify_session, lambda path: repair_session(path, lambda: 0)])
@pytest.mark.parametrize("journal", ["whole", "damaged", "gone"])
def test_what_looks_into_it_says_that_it_was_renamed_and_what_to_do(make, copy, look, journal):
    if journal == "damaged":
        (copy / JOURNAL_NAME).write_text("{oops\n" + (copy / JOURNAL_NAME).read_text())
    if journal == "gone":
        for path in [copy / JOURNAL_NAME, *copy.glob("0*.mcap*")]:
            path.unlink()
    before = make.tree(copy)
    with pytest.raises(InputError) as refused:
        look(copy)
    assert str(refused.value) == (
        f"{copy}: was renamed: its recording is called 2026-01-02-grid-01.mcap. Nothing is damaged by that. "
        f"Rename the folder back to 2026-01-02-grid-01, or give the file {copy}/2026-01-02-grid-01.mcap itself"
    )
    assert refused.value.exit_code == 2
    assert make.tree(copy) == before


def test_both_ways_out_work(copy, tmp_path):
    recording = copy / "2026-01-02-grid-01.mcap"
    assert verify_session(recording).sound
    assert Recording(recording).strokes() == 2
    export(recording, tmp_path / "exported", "png")
    assert (tmp_path / "exported" / "strokes.csv").is_file()
    back = copy.rename(copy.with_name("2026-01-02-grid-01"))
    assert verify_session(back).sound
    assert repair_session(back, lambda: 0).did == []


def test_a_recording_that_was_renamed_with_its_folder_is_sound(copy):
    (copy / "2026-01-02-grid-01.mcap").rename(copy / "s1.mcap")
    assert verify_session(copy).sound
    assert details(copy).file == "s1.mcap"


def test_damage_under_another_name_is_found_once_it_has_its_own_again(copy):
    next(copy.glob("*-press-*.mcap")).unlink()
    with pytest.raises(InputError, match="was renamed"):
        repair_session(copy, lambda: 0)
    assert not verify_session(copy.rename(copy.with_name("2026-01-02-grid-01"))).sound


def test_the_list_names_it(copy):
    assert list(summaries(copy.parent)) == [Summary("s1", "renamed", "loopback rig", 2, "2026-01-02-grid-01.mcap")]


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


def test_the_command_says_it_in_the_front_doors_way(copy):
    ran = CliRunner().invoke(app, ["verify", str(copy)])
    assert isinstance(ran.exception, InputError)
    assert ran.output == ""


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
