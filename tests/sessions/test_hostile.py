"""A folder from a stranger: whatever it says, nothing outside it is written, renamed, or read as its data.

An audit hook sees every file that the process opens, links, renames or removes, whoever does it and by what name.
"""

import os
import shutil
import sys

import pytest
import zstandard

from brushloop.collect.engine.open_or_resume import open_sessions
from brushloop.sessions.errors import InputError
from brushloop.sessions.events import parse_event
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session
from tests.command import brushloop

SECRET = b"the key to the safe"
PRECIOUS = ("victim.mcap", "victim.toml", "victim.mcap.part", "journal.jsonl", "calibration/0123456789abcdef.json")
CALLS = ("rename", "link", "symlink", "remove", "truncate", "mkdir", "rmdir", "listdir")
WATCHED = ("open", *(f"os.{call}" for call in CALLS))
COMMANDS = {
    "list": ["sessions", "list", "{root}"],
    "show": ["sessions", "show", "{session}"],
    "show json": ["sessions", "show", "{session}", "--json"],
    "verify": ["sessions", "verify", "{session}"],
    "repair": ["sessions", "repair", "{session}"],
    "close": ["sessions", "close", "{session}"],
    "export": ["sessions", "export", "{session}", "{out}"],
    "export a file": ["sessions", "export", "{file}", "{out}-2"],
    "calibrate": ["calibrate", "{session}"],
    "fit": ["fit", "{session}"],
    "validate": ["validate", "{session}"],
    "validate a file": ["validate", "{file}"],
}


@pytest.fixture(scope="session")
def opened_outside():
    """Paths under `watch[0]` that were touched while the list has an item; one hook for the whole run."""
    watch, seen = [], []

    def hook(event, args):
        if not watch or event not in WATCHED:
            return
        for path in args[:2]:
            if isinstance(path, str | bytes | os.PathLike):
                where = os.path.realpath(os.fsdecode(path))
                if where == watch[0] or where.startswith(watch[0] + os.sep):
                    seen.append(f"{event} {where}")

    sys.addaudithook(hook)
    return watch, seen


@pytest.fixture
def place(make, tmp_path):
    """`outside` with precious files, and `root` with a closed session to damage, its files beside it."""
    outside = tmp_path / "outside"
    (outside / "calibration").mkdir(parents=True)
    for name in PRECIOUS:
        (outside / name).write_bytes(SECRET)
    make.session(tmp_path / "root" / make.header.session_id, closed=True)
    make.record(outside / "whole.mcap", *make.strokes(2))
    return tmp_path


def named(name, event="done"):
    """Every line of this event names the file `name`."""
    return lambda make, folder, outside: make.rewrite_journal(folder, event, file=name.format(out=outside))


def snapshot(name):
    """A snapshot of the configuration has this name."""
    return lambda make, folder, outside: make.rewrite_journal(
        folder, "open", snapshots={name.format(out=outside): "written by a stranger"}
    )


def linked(pattern, to):
    """A file or folder of the session is a link."""

    def damage(make, folder, outside):
        path = next(iter(sorted(folder.glob(pattern))), folder / pattern)
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.symlink_to(outside / to)

    return damage


def session_id(make, folder, _):
    """The header names a folder elsewhere."""
    elsewhere = {"session_id": "../../outside/calibration"}
    make.rewrite_journal(folder, "open", header=make.header.model_dump(mode="json") | elsewhere)


WAYS = {
    "absolute path in done": named("{out}/victim.mcap"),
    "path upwards in done": named("../../outside/victim.mcap"),
    "path upwards in begin": named("../../outside/victim.mcap", "begin"),
    "two dots": named(".."),
    "nul": named("a\0b.mcap"),
    "snapshot upwards": snapshot("../../outside/victim.toml"),
    "absolute snapshot": snapshot("{out}/victim.toml"),
    "session id": session_id,
    "step is a link": linked("*-press-*.mcap", "whole.mcap"),
    "cut step is a link": linked("*.mcap.part", "victim.mcap.part"),
    "merged file is a link": linked("2026-01-02-grid-01.mcap", "whole.mcap"),
    "journal is a link": linked(JOURNAL_NAME, "journal.jsonl"),
    "remarks are a link": linked("remarks.jsonl", "journal.jsonl"),
    "configuration is a link": linked("rig.toml", "victim.toml"),
    "lock is a link": linked(".lock", "victim.toml"),
    "calibration is a link": linked("calibration", "calibration"),
    "brush fit is a link": linked("brushfit", "calibration"),
    "validation is a link": linked("validation", "calibration"),
    "a kept copy is a link": linked("rig.toml.damaged-1", "nowhere"),
    "a copy in the making is a link": linked("journal.jsonl.repair", "victim.toml"),
}


@pytest.mark.parametrize("way", WAYS)
def test_nothing_outside_the_folder_is_touched(make, place, opened_outside, way, monkeypatch):
    outside, folder = place / "outside", place / "root" / make.header.session_id
    before = make.tree(outside)
    WAYS[way](make, folder, outside)
    monkeypatch.chdir(place)
    watch, seen = opened_outside
    places = {"root": folder.parent, "session": folder, "out": place / "out", "file": folder / f"{folder.name}.mcap"}
    for name, words in COMMANDS.items():
        seen.clear()
        watch.append(str(outside))
        try:
            ran = brushloop(*(word.format(**places) for word in words))
        finally:
            watch.clear()
        given = name in ("export a file", "validate a file") and way == "merged file is a link"
        assert given or not seen, f"{name}: {seen}"
        assert SECRET.decode() not in ran.stdout + ran.stderr
        assert ran.returncode != 1, f"{name}: {ran.stderr}"
        assert make.tree(outside) == before, f"{name} changed something outside"
    written = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    assert not any(SECRET in path.read_bytes() for path in written)


def test_a_link_among_the_sessions_is_what_the_user_made(make, place):
    """The folder itself may be on another disk; what is in it may not."""
    folder = place / "root" / make.header.session_id
    elsewhere = place / "disk" / folder.name
    elsewhere.parent.mkdir()
    folder.rename(elsewhere)
    folder.symlink_to(elsewhere)
    ran = brushloop("sessions", "verify", folder)
    assert (ran.returncode, "is sound" in ran.stdout) == (0, True)


def test_a_session_that_is_gone_on_with_holds_no_link(make, place):
    folder = place / "root" / "2026-01-03-grid-01"
    make.store(folder).release()
    (folder / "rig.toml").unlink()
    (folder / "rig.toml").symlink_to(place / "outside" / "victim.toml")
    with pytest.raises(InputError, match=r"rig\.toml: is a link, which is not allowed in a session's folder") as caught:
        SessionStore(folder, make.clock())
    assert caught.value.exit_code == 2
    assert folder not in open_sessions(folder.parent)


@pytest.mark.parametrize("name", ["", "..", "/etc/x", "../x", "a/b", "a\\b", "a\0b", "a\nb", "x" * 300, ".x", "x\n/"])
def test_a_name_in_a_journal_never_leads_out_of_its_folder(name):
    with pytest.raises(ValueError, match="'file' of event 'closed' is wrong"):
        parse_event({"event": "closed", "t_ns": 1, "file": f"{name}.mcap", "sha256": "", "counts": {}})


HUGE = 2**28 + 1


def test_a_journal_that_is_too_large_ends_in_one_line_hides_no_other_and_is_made_again(make, tmp_path, repair):
    huge, sound = (make.session(tmp_path / name, session_id=name) for name in ("huge", "sound"))
    os.truncate(huge / JOURNAL_NAME, HUGE)
    for words in (("sessions", "show", huge), ("sessions", "close", huge), ("validate", huge)):
        ran = brushloop(*words, cwd=tmp_path)
        assert (ran.returncode, "is larger than 268435456 bytes" in ran.stderr) == (6, True)
        assert "Traceback" not in ran.stderr
    assert open_sessions(tmp_path) == [sound]
    assert not repair(huge).lost
    assert (huge / f"{JOURNAL_NAME}.damaged-1").stat().st_size == HUGE
    assert verify_session(huge).sound


def test_too_little_memory_is_no_damage(make, closed, repair, monkeypatch):
    before = make.tree(closed)

    def exhausted(*_, **__):
        raise MemoryError

    monkeypatch.setattr(zstandard, "ZstdDecompressor", exhausted)
    monkeypatch.setattr(zstandard, "decompress", exhausted)
    for look in (verify_session, repair):
        with pytest.raises(MemoryError):
            look(closed)
    assert make.tree(closed) == before
