"""Damage anywhere in an MCAP file: read as it was written, or refused in one line that names the file."""

import io
import random

import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk

from brushloop.sessions.errors import InputError, SessionDamaged
from brushloop.sessions.recording import Recording

CUTS = 120
FLIPS = 400


@pytest.fixture
def whole(make, store):
    """A merged recording with attachments, metadata and two strokes, as bytes."""
    make.perform(store, "a")
    make.perform(store, "b")
    return store.close().read_bytes()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "damaged.mcap"


def everything(path):
    """All that a reader can get out of a recording."""
    recording = Recording(path)
    captures = [(capture.stroke.stroke_id, capture.still_png) for capture in recording.captures()]
    rig = recording.attachment("rig.toml")
    return recording.header, captures, rig, recording.strokes(), list(recording.stills_of("board"))


def refusal(path):
    """The error in one line, None where it was read; anything but our own errors fails the test."""
    try:
        everything(path)
    except (InputError, SessionDamaged) as error:
        message = str(error)
    else:
        return None
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


def test_a_file_cut_short_anywhere_is_refused(whole, path):
    chosen = random.Random(5)
    for cut in [*range(12), *range(len(whole) - 60, len(whole)), *chosen.choices(range(len(whole)), k=CUTS)]:
        path.write_bytes(whole[:cut])
        assert refusal(path), f"cut at {cut} of {len(whole)} was not noticed"


def test_a_flipped_bit_is_refused_or_changes_nothing(whole, path):
    path.write_bytes(whole)
    as_written = everything(path)
    chosen = random.Random(6)
    refused = 0
    for _ in range(FLIPS):
        data, at = bytearray(whole), chosen.randrange(len(whole))
        data[at] ^= 1 << chosen.randrange(8)
        path.write_bytes(data)
        if refusal(path):
            refused += 1
        else:
            assert everything(path) == as_written, f"bit at {at} changed what was read, unnoticed"
    assert refused > FLIPS / 2


def with_chunk(whole, **changes):
    """The same file, its first chunk's fields changed in place; lengths stay."""
    index = make_reader(io.BytesIO(whole)).get_summary().chunk_indexes[0]
    start = index.chunk_start_offset
    builder = RecordBuilder()
    chunk = Chunk.read(ReadDataStream(io.BytesIO(whole[start + 9 :])))
    for name, value in changes.items():
        setattr(chunk, name, value)
    chunk.write(builder)
    return whole[:start] + builder.end() + whole[start + index.chunk_length :]


def test_a_chunk_that_states_a_terabyte_is_refused_before_it_is_unpacked(whole, path):
    path.write_bytes(with_chunk(whole, uncompressed_size=1 << 40))
    with pytest.raises(SessionDamaged, match="exceeds"):
        list(Recording(path).captures())


def test_a_zstd_frame_that_states_a_terabyte_is_refused_before_it_is_unpacked(whole, path):
    index = make_reader(io.BytesIO(whole)).get_summary().chunk_indexes[0]
    frame = zstandard.FRAME_HEADER + b"\xe0" + (1 << 40).to_bytes(8, "little")
    path.write_bytes(with_chunk(whole, data=frame.ljust(index.compressed_size, b"\0")))
    with pytest.raises(SessionDamaged, match="chunk of 1099511627776 bytes exceeds"):
        list(Recording(path).captures())


def test_a_chunk_compressed_in_a_way_that_cannot_be_bounded_is_refused(whole, path):
    path.write_bytes(with_chunk(whole, compression="lz4!"))
    with pytest.raises(SessionDamaged, match="allowed: zstd or none"):
        list(Recording(path).captures())
