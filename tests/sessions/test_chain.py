"""The chain of a journal: each line names the one before it, and damage to whole lines is reported by number."""

import hashlib
import json

import pytest

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.journal.codec import encode_line
from brushloop.sessions.journal.journal import JOURNAL_NAME, replay
from brushloop.sessions.journal.lines import read, read_lines
from brushloop.sessions.repair.repair import repair_session
from brushloop.sessions.repair.verify import verify_session
from brushloop.sessions.store import SessionStore


@pytest.fixture
def folder(make, store):
    """An open session of two strokes, released."""
    make.collect(store)
    store.release()
    return store.folder


def lines_of(folder):
    return (folder / JOURNAL_NAME).read_bytes().splitlines(keepends=True)


def write(folder, lines):
    (folder / JOURNAL_NAME).write_bytes(b"".join(lines))


def unchain(folder):
    """The journal as an older version wrote it."""
    lines = list(read_lines(folder / JOURNAL_NAME))
    write(folder, [encode_line(line.pop("t_ns"), line) for line in lines])


def faults(folder):
    return [finding.what for finding in verify_session(folder).findings if finding.file == JOURNAL_NAME]


def test_each_line_says_its_number_its_session_and_the_hash_of_the_line_before(folder):
    lines = lines_of(folder)
    prev = hashlib.sha256(b"").hexdigest()
    for number, line in enumerate(lines, start=1):
        assert json.loads(line)["chain"] == {"seq": number, "session": folder.name, "prev": prev}
        prev = hashlib.sha256(line.rstrip(b"\n")).hexdigest()


def test_a_session_that_is_gone_on_with_goes_on_with_its_chain(make, folder):
    SessionStore(folder, None, make.clock()).release()
    reading = read((folder / JOURNAL_NAME).read_bytes())
    assert (reading.faults, reading.unchained, len(reading.entries)) == ([], 0, len(lines_of(folder)))


def test_a_torn_last_line_is_no_damage_and_its_note_is_chained(make, folder):
    *lines, last = lines_of(folder)
    write(folder, [*lines, last[:-9]])
    assert verify_session(folder).sound
    SessionStore(folder, None, make.clock()).release()
    assert make.events(folder, "torn")[0]["hex"] == last[:-9].hex()
    assert faults(folder) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda a: [*a[:4], *a[5:]], ["line 5 comes after a line that is missing"]),
        (lambda a: [*a[:4], *a[7:]], ["line 5 comes after 3 lines that are missing"]),
        (lambda a: a[1:], ["line 1 comes after a line that is missing"]),
        (lambda a: [*a[:5], a[4], *a[5:]], ["line 6 stands twice: it is line 5"]),
        (lambda a: [*a[:4], a[5], a[4], *a[6:]], ["line 6 is out of place: it was written as line 5"]),
        (
            lambda a: [*a[:3], a[9], *a[4:9], a[3], *a[10:]],
            [
                "line 4 is out of place: it was written as line 10",
                "line 10 is out of place: it was written as line 4",
            ],
        ),
    ],
    ids=["deleted", "three deleted", "first deleted", "doubled", "neighbours", "exchanged"],
)
def test_what_happened_to_whole_lines_is_named(folder, change, expected):
    write(folder, change(lines_of(folder)))
    assert [fault for fault in faults(folder) if fault.startswith("line")] == expected
    with pytest.raises(SessionDamaged, match=expected[0]):
        replay(folder / JOURNAL_NAME)


def test_a_line_of_another_session_is_named(make, folder, tmp_path):
    other = make.store(tmp_path / "other", session_id="other")
    other.release()
    write(folder, [*lines_of(folder)[:6], lines_of(other.folder)[1], *lines_of(folder)[6:]])
    assert faults(folder) == ["line 7 is of another session, 'other'"]
    assert repair_session(folder, make.clock()).lossless


def test_a_line_that_was_edited_with_its_crc_made_right_is_named(make, folder):
    lines = lines_of(folder)
    at = next(at for at, line in enumerate(lines) if b'"done"' in line and b"press" in line)
    line = json.loads(lines[at])
    line.pop("crc")
    line["result"]["depth_mm"] = 99.0
    lines[at] = encode_line(line.pop("t_ns"), line)
    write(folder, lines)
    assert faults(folder) == [f"line {at + 1} was changed after it was written: line {at + 2} does not follow from it"]
    assert repair_session(folder, make.clock()).lossless
    assert make.events(folder, "done")[1]["result"]["depth_mm"] == 13.0


def test_an_older_session_is_sound_and_reported_as_unchained(folder):
    unchain(folder)
    verdict = verify_session(folder)
    assert verdict.sound
    assert f"{len(lines_of(folder))} of {len(lines_of(folder))} lines are unchained" in verdict.notes[0]


def test_an_older_session_that_is_gone_on_with_is_chained_from_there_on(make, folder):
    unchain(folder)
    before = lines_of(folder)
    make.perform(store := SessionStore(folder, None, make.clock()), "later")
    store.release()
    first = json.loads(lines_of(folder)[len(before)])["chain"]
    assert (first["seq"], first["prev"]) == (len(before) + 1, hashlib.sha256(b"".join(before)).hexdigest())
    assert verify_session(folder).sound
    write(folder, [*before[:3], *before[4:], *lines_of(folder)[len(before) :]])
    assert f"line {len(before)} comes after a line that is missing" in faults(folder)


def test_an_older_line_that_is_changed_after_the_chain_began_is_noticed(make, folder):
    unchain(folder)
    before = lines_of(folder)
    SessionStore(folder, None, make.clock()).release()
    lines = lines_of(folder)
    lines[0], lines[1] = lines[1], lines[0]
    write(folder, lines)
    assert faults(folder) == [
        f"line {len(before) + 1} does not follow from the lines before it: one of them was changed"
    ]


def test_a_journal_of_before_lines_had_a_crc_is_gone_on_with(make, folder):
    lines = list(read_lines(folder / JOURNAL_NAME))
    write(folder, [json.dumps(line).encode() + b"\n" for line in lines])
    SessionStore(folder, None, make.clock()).release()
    again = list(read_lines(folder / JOURNAL_NAME))
    assert (again[: len(lines)], again[-1]["event"]) == (lines, "process")


@pytest.mark.parametrize("chained", [True, False])
def test_a_step_that_is_done_twice_is_damage_and_its_stroke_comes_once(make, folder, chained):
    if not chained:
        unchain(folder)
    lines = lines_of(folder)
    done = next(line for line in lines if b'"done"' in line and b"capture" in line)
    write(folder, [*lines, done])
    assert any("twice" in fault or "was done already" in fault for fault in faults(folder))
    assert repair_session(folder, make.clock()).lossless
    store = SessionStore(folder, None, make.clock())
    assert make.stroke_names(store.close()) == ["H13-a05-r00", "H13-a05-r01"]
    store.release()
    assert verify_session(folder).sound
