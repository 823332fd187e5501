"""The journal: what it says happened, happened, whatever was cut off or did not fit on the disk."""

import errno
import os
import re
from pathlib import Path

import pytest

from brushloop.sessions.errors import SessionDamaged, SessionError
from brushloop.sessions.events import Remark, parse_event
from brushloop.sessions.journal import Journal, read, replay, seal
from brushloop.sessions.recording import REMARKS_NAME, add_remark, remarks_of
from tests.journal_lines import read_lines

BEGIN = {
    "event": "begin",
    "key": "k1",
    "kind": "press",
    "attempt": 1,
    "sheet": 0,
    "patches": [4],
    "file": "0000-k1.mcap",
}
DONE = {
    **BEGIN,
    "event": "done",
    "sha256": "00",
    "counts": {"/step": 2},
    "result": {"kind": "press", "press": {"stroke_id": "a", "condition": {"depth_mm": 13.0, "tilt_deg": 5.0}}},
}


def written(path, *lines, t_ns=1):
    journal = Journal(path, "s")
    for line in lines:
        journal.append(parse_event({"t_ns": t_ns, **line}))
    journal.close()
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal.jsonl"


def test_every_line_is_on_disk_before_append_returns(path, monkeypatch):
    journal = Journal(path)
    synced = []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (fsync(fd), synced.append(path.read_bytes().count(b"\n"))))
    for _ in range(3):
        journal.append(parse_event({"t_ns": 1, **BEGIN}))
    journal.close()
    assert synced == [1, 2, 3]


def test_a_last_line_torn_at_any_byte_is_removed_and_one_without_only_its_end_is_whole(path):
    whole = written(path, BEGIN, DONE).read_bytes()
    last_line_at = whole.index(b"\n") + 1
    for cut in range(last_line_at + 1, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert len(list(read_lines(path))) == 1
        written(path, DONE)
        assert path.read_bytes() == whole
    path.write_bytes(whole[:-1])
    assert [line["event"] for line in read_lines(path)] == ["begin", "done"]
    written(path, {"event": "sheet", "sheet": 1})
    assert [line["event"] for line in read_lines(path)] == ["begin", "done", "sheet"]


LINES = [seal({"seq": n, "session": "s", "t_ns": 1, "event": "sheet", "sheet": n}) for n in range(1, 13)]
FOREIGN = seal({"seq": 7, "session": "other", "t_ns": 1, "event": "sheet", "sheet": 7})
BARE = seal({"seq": 5, "session": "s", "t_ns": 1, "event": "sheet"})
WRONG = "line 5 does not match its CRC"

CHANGES = {
    "deleted": (lambda a: [*a[:4], *a[5:]], ["line 5 is numbered 6"]),
    "first": (lambda a: a[1:], ["line 1 is numbered 2"]),
    "doubled": (lambda a: [*a[:5], a[4], *a[5:]], ["line 6 is numbered 5"]),
    "exchanged": (lambda a: [*a[:3], a[9], *a[4:9], a[3], *a[10:]], ["line 4 is numbered 10"]),
    "foreign": (lambda a: [*a[:6], FOREIGN, *a[6:]], ["line 7 is of another session, 'other'", "line 8 is numbered 7"]),
    "binary": (lambda a: [*a[:4], b"\xff\xfe\n", *a[5:]], [WRONG]),
    "deep": (lambda a: [*a[:4], b"[" * 100_000 + b"\n", *a[5:]], [WRONG]),
    "bit": (lambda a: [*a[:4], a[4].replace(b"sheet", b"sheer"), *a[5:]], [WRONG]),
    "end": (lambda a: [*a[:4], a[4][:-1] + b"\x0b", *a[5:]], [WRONG, "line 6 is numbered 7"]),
    "field": (lambda a: [*a[:4], BARE, *a[5:]], ["line 5 makes no sense: 'sheet' of event 'sheet' is missing"]),
    "torn": (lambda a: [*a[:-1], a[-1][:-9]], []),
}


@pytest.mark.parametrize(("change", "expected"), CHANGES.values(), ids=CHANGES)
def test_what_happened_to_lines_is_named(path, change, expected):
    path.write_bytes(b"".join(change(LINES)))
    faults = read(path.read_bytes()).faults
    assert len(faults) == len(expected)
    assert all(fault.startswith(start) for fault, start in zip(faults, expected, strict=True)), faults
    if expected:
        with pytest.raises(SessionDamaged, match=re.escape(expected[0])) as caught:
            replay(path)
        assert caught.value.path == path


def test_a_step_that_is_done_twice_is_damage(path):
    with pytest.raises(SessionDamaged, match="had done the same step before"):
        replay(written(path, BEGIN, DONE, DONE))


def test_what_does_not_fit_on_the_disk_is_an_error_and_damages_nothing(path, monkeypatch):
    journal = Journal(path)
    journal.append(parse_event({"t_ns": 1, **BEGIN}))
    write = os.write

    def half_then_full(fd, data):
        if len(data) < 40:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(fd, bytes(data)[: len(data) // 2])

    with monkeypatch.context() as full_disk:
        full_disk.setattr(os, "write", half_then_full)
        with pytest.raises(SessionError, match="cannot write: No space left on device"):
            journal.append(parse_event({"t_ns": 2, **DONE}))
    assert not path.read_bytes().endswith(b"\n"), "the test means to leave half a line"
    journal.append(parse_event({"t_ns": 3, **DONE}))
    journal.close()
    assert [line["t_ns"] for line in read_lines(path)] == [1, 3]


def test_the_latest_remark_on_a_capture_holds_and_the_earlier_ones_stay(tmp_path: Path) -> None:
    assert remarks_of(tmp_path) == {}
    ran = Remark(t_ns=1, still=4, stroke_id="H13-a0-r01", bad=True, note="墨 ran")
    pale = Remark(t_ns=2, still=7, stroke_id="H13-a0-r02", bad=False, note="pale")
    good = Remark(t_ns=3, still=4, stroke_id="H13-a0-r01", bad=False, note="good after all")
    for remark in (ran, pale, good):
        add_remark(tmp_path, remark)
    assert remarks_of(tmp_path) == {4: good, 7: pale}
    assert "ran" in (tmp_path / REMARKS_NAME).read_text(encoding="utf-8")
