"""Reading a recording: strokes with their stills, one at a time; whatever else a file holds is refused in one line."""

import io
import json

import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from brushloop.sessions.errors import InputError, SessionDamaged
from brushloop.sessions.events import StepKind
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import HEADER_FILE, Topic
from brushloop.sessions.repair import repair_session
from brushloop.sessions.show import details
from brushloop.sessions.verify import verify_session
from tests.command import brushloop


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mcap"


def foreign(path, header=None, messages=(), **options):
    """An MCAP file written by somebody else, with this text as its header: (topic, encoding, data) of its messages."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        writer.add_metadata("trip", {"car": "blue"})
        if header is not None:
            writer.add_attachment(0, 0, HEADER_FILE, "application/json", header.encode())
        for number, (topic, encoding, data) in enumerate(messages):
            channel = writer.register_channel(topic, encoding, 0)
            writer.add_message(channel, number, data, number, 0)
        writer.finish()
    return path


def test_every_stroke_comes_with_the_still_that_shows_it(make, path):
    make.record(path, *make.strokes(2), make.stroke(1, stroke_id="beside"))
    captures = list(Recording(path).captures())
    assert [capture.stroke.stroke_id for capture in captures] == ["H13-a05-r00", "H13-a05-r01", "beside"]
    assert [capture.still_png for capture in captures] == [make.png(0), make.png(1), make.png(1)]
    assert captures[0].image().shape == (24, 24)
    assert Recording(path).counts[Topic.STROKE] == 3


def test_stills_are_found_by_the_kind_of_their_step(make, closed):
    recording = Recording(closed)
    assert list(recording.stills_of("board")) == [(make.still(1000).log_ns, make.png(1000))]
    assert len(list(recording.stills_of("capture"))) == 2
    assert list(recording.stills_of("dip")) == []


@pytest.mark.parametrize("content", [b"", b"{}", b"hello, world: this is no recording\n" * 30], ids=str)
def test_what_is_no_mcap_file_is_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(InputError, match="is not an MCAP file"):
        Recording(path)


def test_an_open_session_is_refused_with_the_way_out(make, store):
    make.perform(store, "a")
    with pytest.raises(InputError, match="still open: run the same `brushloop collect` again"):
        Recording(store.folder)


@pytest.mark.parametrize(
    "damaged",
    [
        {"session_id": "not json"},
        {"source": '"somewhere"'},
        {"brush_radius_mm": "NaN"},
        {"unknown": "1"},
        {"lens": "[" * 5000},
    ],
    ids=lambda damaged: next(iter(damaged)),
)
def test_a_header_that_cannot_be_read_is_reported_in_one_line(make, path, damaged):
    texts = {name: json.dumps(value) for name, value in make.header.model_dump(mode="json").items()} | damaged
    foreign(path, "{" + ",".join(f'"{name}":{text}' for name, text in texts.items()) + "}")
    with pytest.raises(SessionDamaged) as caught:
        Recording(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("topic", "data", "message"),
    [
        ("/stroke", b"\xff", "Stroke"),
        ("/stroke", b'{"stroke_id":"a","kind":"press"}', "Stroke still"),
        ("/stroke", b'{"stroke_id":"a","kind":"press","still":-1}', "Stroke still"),
        ("/stroke", b'{"stroke_id":"a","kind":"press","still":3}', "refers to photograph 3, which is missing"),
        ("/stroke", b'{"stroke_id":"a","kind":"press","still":0,"depth_mm":NaN}', "Stroke depth_mm"),
        ("/stroke", b'{"stroke_id":"a","kind":"press","still":0,"px_per_mm":[0,0]}', "Stroke px_per_mm"),
        ("/stroke", b'{"stroke_id":"a","kind":"press","still":0,"extra":0}', "Stroke extra"),
        ("/camera/still", b"\xff\xff\xff", "the message of a photograph cannot be decoded"),
    ],
)
def test_a_message_that_cannot_be_read_names_its_field(make, path, topic, data, message):
    foreign(path, make.header.model_dump_json(), [(topic, "json", data)])
    recording = Recording(path)
    with pytest.raises(SessionDamaged, match=message) as caught:
        list(recording.captures())
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_messages_outside_chunks_are_refused_because_no_crc_protects_them(make, path):
    foreign(path, make.header.model_dump_json(), [("/stroke", "json", b"{}")], use_chunking=False)
    with pytest.raises(SessionDamaged, match="outside chunks"):
        Recording(path)


def with_chunk(whole, **changes):
    """The same file, its first chunk's fields changed in place; lengths stay."""
    index = make_reader(io.BytesIO(whole)).get_summary().chunk_indexes[0]
    start = index.chunk_start_offset
    builder = RecordBuilder()
    chunk = Chunk.read(ReadDataStream(io.BytesIO(whole[start + 9 :])))
    for name, value in changes.items():
        setattr(chunk, name, value.ljust(len(chunk.data), b"\0") if name == "data" else value)
    chunk.write(builder)
    return whole[:start] + builder.end() + whole[start + index.chunk_length :]


FRAME = zstandard.FRAME_HEADER + b"\xe0" + (1 << 40).to_bytes(8, "little")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"uncompressed_size": 1 << 40}, "exceeds"),
        ({"data": FRAME}, "chunk of 1099511627776 bytes exceeds"),
        ({"compression": "lz4!"}, "allowed: zstd or none"),
    ],
    ids=["chunk", "frame", "compression"],
)
def test_a_chunk_that_states_a_terabyte_is_refused_before_it_is_unpacked(make, path, changes, message):
    whole = make.record(path, *make.strokes(2)).read_bytes()
    path.write_bytes(with_chunk(whole, **changes))
    with pytest.raises(SessionDamaged, match=message):
        list(Recording(path).captures())


def test_a_chunk_whose_data_claim_a_terabyte_is_damage(make, path):
    whole = bytearray(make.record(path, *make.strokes(2)).read_bytes())
    start = make_reader(io.BytesIO(whole)).get_summary().chunk_indexes[0].chunk_start_offset
    place = start + 9 + 8 + 8 + 8 + 4 + 4 + len("zstd")  # behind the fields before: the length of the compressed data
    whole[place + 5] ^= 1
    path.write_bytes(whole)
    assert not verify_session(path).sound


LOOKS = [Recording, details, verify_session, lambda path: repair_session(path, lambda: 0)]


@pytest.mark.parametrize("look", LOOKS)
def test_what_is_no_session_is_named_as_what_it_is(make, store, tmp_path, look):
    store.begin("k", StepKind.PRESS, patches=(0,)).writer.abandon()
    (part,) = store.folder.glob("*.part")
    (tmp_path / "empty").mkdir()
    before = make.tree(tmp_path)
    for path, message in (
        (part, f"is unfinished, .* Give the session's folder, {store.folder}"),
        (tmp_path / "empty", r"it holds neither journal\.jsonl nor a recording empty\.mcap"),
        (tmp_path, rf"is not a session but holds 1 of them: give one, such as {store.folder}"),
        (tmp_path / "gone", "no such session"),
    ):
        with pytest.raises(InputError, match=message) as refused:
            look(path)
        assert refused.value.exit_code == 2
    assert make.tree(tmp_path) == before


@pytest.mark.parametrize("command", ["verify", "repair"])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_a_recording_of_another_program_is_no_session_and_not_damaged(tmp_path, command, compression):
    path = tmp_path / "drive.mcap"
    foreign(path, messages=[("/stroke", "cdr", b"\0\1\0\0")], compression=compression)
    before = path.read_bytes()
    ran = brushloop("sessions", command, path)
    assert (ran.returncode, ran.stdout) == (2, "")
    what = f"is an MCAP file, but not a brushloop session: its index lists no {HEADER_FILE}"
    assert ran.stderr == f"brushloop: {path}: {what}\n"
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (before, [path])
