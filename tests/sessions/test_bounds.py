"""A file that states or has an absurd size ends in one clear line, and too little memory is never taken for damage."""

import os

import pytest
import zstandard

from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.repair import repair_session
from brushloop.sessions.store import open_sessions
from brushloop.sessions.verify import verify_session
from tests.command import brushloop

HUGE = 40 * 2**30


@pytest.fixture
def huge(make, tmp_path):
    """A session whose journal claims 40 GB, beside an open one that is sound."""
    for name in ("huge", "sound"):
        store = make.store(tmp_path / "sessions" / name, session_id=name)
        make.collect(store)
        store.release()
    os.truncate(tmp_path / "sessions" / "huge" / JOURNAL_NAME, HUGE)
    return tmp_path / "sessions" / "huge"


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("sessions", "show"), 6),
        (("sessions", "verify"), 6),
        (("sessions", "close"), 6),
        (("sessions", "export", "out"), 6),
        (("validate",), 6),
    ],
)
def test_a_journal_of_40_gb_ends_in_one_line(huge, words, code, tmp_path):
    command, more = words[:2], words[2:]
    ran = brushloop(*command, str(huge), *more, cwd=tmp_path)
    assert ran.returncode == code
    assert "is larger than 268435456 bytes" in ran.stdout + ran.stderr
    assert "Traceback" not in ran.stderr


def test_it_is_made_again_from_the_files(make, huge):
    report = repair_session(huge, make.clock())
    assert (report.strokes, report.lost) == (2, [])
    assert (huge / f"{JOURNAL_NAME}.damaged-1").stat().st_size == HUGE
    assert verify_session(huge).sound


def test_one_unreadable_session_stands_in_no_others_way(huge, tmp_path):
    (huge.parent / "linked").mkdir()
    (huge.parent / "linked" / JOURNAL_NAME).symlink_to(huge.parent / "sound" / JOURNAL_NAME)
    assert [folder.name for folder in open_sessions(huge.parent)] == ["sound"]
    ran = brushloop("sessions", "list", str(huge.parent), cwd=tmp_path)
    assert (ran.returncode, ran.stdout.count("damaged")) == (0, 2)


def test_too_little_memory_is_no_damage(make, store, monkeypatch):
    make.collect(store)
    store.close()
    store.release()
    before = make.tree(store.folder)

    def exhausted(*_, **__):
        raise MemoryError

    class NoMemory:
        decompress = exhausted
        decompressobj = exhausted

    monkeypatch.setattr(zstandard, "ZstdDecompressor", NoMemory)
    monkeypatch.setattr(zstandard, "decompress", exhausted)
    for look in (verify_session, lambda folder: repair_session(folder, make.clock())):
        with pytest.raises(MemoryError):
            look(store.folder)
    assert make.tree(store.folder) == before
