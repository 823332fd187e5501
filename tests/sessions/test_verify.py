"""Verify names what is damaged in words, and finds nothing where nothing is."""

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from typer.testing import CliRunner

from brushloop.sessions.cli import app
from brushloop.sessions.errors import InputError
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.records import HEADER_NOTE as HEADER
from brushloop.sessions.verify import verify_session
from tests.command import brushloop


@pytest.fixture
def folder(make, store):
    make.collect(store)
    store.close()
    store.release()
    return store.folder


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def words(folder):
    return [f"{finding.file}: {finding.what}" for finding in verify_session(folder).findings]


def test_a_sound_session_open_or_closed(make, store):
    make.collect(store)
    opened = verify_session(store.folder)
    assert (opened.sound, opened.state, opened.files, opened.strokes) == (True, "open", 5, 2)
    store.close()
    closed = verify_session(store.folder)
    assert (closed.sound, closed.state, closed.files, closed.messages) == (True, "closed", 6, opened.messages)
    assert verify_session(store.folder / f"{store.folder.name}.mcap").sound


def test_a_flipped_bit_of_a_photograph_is_named_with_its_step(folder):
    path = next(folder.glob("*-capture-*.mcap"))
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    flip(path, chunks[1].chunk_start_offset + chunks[1].chunk_length // 2)
    [finding] = words(folder)
    assert finding.startswith(f"{path.name}: (capture H13-a05-r00) the chunk at byte")
    assert finding.endswith("messages lost: 1 of /camera/still")


def test_what_is_missing_is_named(folder):
    (folder / f"{folder.name}.mcap").unlink()
    next(folder.glob("*-press-*.mcap")).unlink()
    assert words(folder) == [
        "0002-press-H13-a05-.mcap: (press H13-a05-r00) is missing, though the journal says it was finished",
        "2026-01-02-grid-01.mcap: is missing, though the journal says it was finished",
    ]


def test_a_damaged_journal_line_is_reported_and_whether_the_files_make_up_for_it(folder):
    journal = folder / JOURNAL_NAME
    flip(journal, journal.read_bytes().index(b'"result":{"kind":"press"'))
    assert words(folder) == ["journal.jsonl: line 8 does not match its CRC"]
    assert "journal.jsonl: all of it can be rebuilt from the files" in verify_session(folder).notes


def test_an_image_that_does_not_decode_is_damage_though_every_crc_holds(make, store):
    make.take(store, "a", [make.still(0, b"no image"), make.stroke(0)], make.captured("", 0))
    [finding] = words(store.folder)
    assert finding.endswith("(capture) the image 0 on /camera/still is not a complete PNG or JPEG image")


def test_a_stroke_without_its_still_is_damage(make, tmp_path):
    path = make.record(tmp_path / "a.mcap", make.still(1), make.stroke(2))
    assert words(path) == ["a.mcap: stroke H13-a05-r02 names still 2, which is not there"]


def test_a_header_with_one_wrong_letter_is_damage(make, tmp_path):
    path = make.record(tmp_path / "a.mcap", *make.strokes(1))
    flip(path, path.read_bytes().index(b"goat"))
    assert any("'brushloop.header' does not match its CRC" in line for line in words(path))


def test_a_line_cut_off_by_a_crash_is_a_note_and_no_damage(make, store):
    make.collect(store)
    store.release()
    with (store.folder / JOURNAL_NAME).open("ab") as file:
        file.write(b'{"t_ns":17,"ev')
    verdict = verify_session(store.folder)
    assert (verdict.sound, "last line was cut off" in verdict.notes[0]) == (True, True)


def test_what_is_no_session_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "gone"):
        with pytest.raises(InputError):
            verify_session(path)


def test_the_command_says_how_much_was_read(folder):
    ran = CliRunner().invoke(app, ["verify", str(folder)])
    assert ran.exit_code == 0
    assert "2026-01-02-grid-01 (closed) is sound: 6 files, 2 strokes, 25 messages" in ran.output


@pytest.mark.parametrize("command", ["verify", "repair"])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_a_recording_of_another_program_is_no_session_and_not_damaged(tmp_path, command, compression):
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start("ros2", "another recorder")
        schema = writer.register_schema("geometry_msgs/Pose", "ros2msg", b"float64 x")
        channel = writer.register_channel("/stroke", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0", 1)
        writer.add_metadata("trip", {"car": "blue"})
        writer.finish()
    before = path.read_bytes()
    ran = brushloop("sessions", command, path)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert (
        ran.stderr == f"brushloop: {path}: is an MCAP file, but not a brushloop session: its index lists no {HEADER}\n"
    )
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (before, [path])
