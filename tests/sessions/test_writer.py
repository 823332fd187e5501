"""One file of a session: all that was written is in it, as the mcap library writes it, and a failing disk is heard."""

import errno
import hashlib
import io
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader

from brushloop.sessions import mcap_writer
from brushloop.sessions.errors import DiskFull, SessionDamaged, SessionError
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.mcap_writer import CHUNK_BYTES, McapWriter, SegmentWriter
from brushloop.sessions.records import HEADER_FILE
from tests.sessions.conftest import Make


@pytest.fixture
def path(tmp_path):
    return tmp_path / "0001-press-abc.mcap"


def write_all(writer, messages):
    for message in messages:
        writer.write(message)


def test_counts_and_digest_tell_what_is_in_the_file(make, path):
    writer = SegmentWriter(path, make.header)
    write_all(writer, [*make.strokes(3), make.pose(41)])
    assert [p.name for p in path.parent.iterdir()] == [f"{path.name}.part"], "it has its name once it is finished"
    sha256 = writer.finish()
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert writer.counts == {"/camera/still": 3, "/stroke": 3, "/robot/tcp": 1}
    assert sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    [pose] = [key for key in make.messages(path) if key[0] == "/robot/tcp"]
    assert pose[1:4] == (41, make.t0_ns + 41, make.t0_ns + 40), "times and sequence are the device's own"


@pytest.mark.parametrize("suffix", ["", ".part"])
def test_a_recording_is_never_overwritten(make, path, suffix):
    there = path.with_name(path.name + suffix)
    there.write_bytes(b"precious")
    with pytest.raises(SessionError, match="never overwritten"):
        SegmentWriter(path, make.header)
    assert make.tree(path.parent) == {there.name: b"precious"}


@pytest.mark.parametrize(
    ("failing", "number", "kind"), [("fsync", errno.ENOSPC, DiskFull), ("rename", errno.EIO, SessionError)]
)
def test_an_error_of_the_last_steps_is_a_session_error(make, path, monkeypatch, failing, number, kind):
    def fail(*_):
        raise OSError(number, os.strerror(number))

    writer = SegmentWriter(path, make.header)
    monkeypatch.setattr(os if failing == "fsync" else Path, failing, fail)
    with pytest.raises(kind, match=os.strerror(number)):
        writer.finish()
    assert [p.name for p in path.parent.iterdir()] == [f"{path.name}.part"]


def test_a_disk_that_does_not_keep_up_is_heard(make, path, monkeypatch):
    monkeypatch.setattr(mcap_writer, "QUEUE_LIMIT", 1)
    writer = SegmentWriter(path, make.header)
    noise = np.random.default_rng(0).bytes(1_000_000)
    with pytest.raises(SessionError, match="1 messages wait to be written: the disk does not keep up"):
        write_all(writer, (make.still(number, noise) for number in range(1000)))
    writer.abandon()


HEADER = Make.header
THING, THINGS = Schema(1, b"{}", "jsonschema", "Thing"), Channel(1, "/things", "json", {}, 1)
BARE = Channel(2, "/bare", "", {}, 0)
SMALL = [Message(THINGS.id, number, b"{}", number + 1, number) for number in range(500)]
LARGE = [Message(BARE.id, 100 - n, bytes(size), 0, 2**32 - 1) for n, size in enumerate((0, CHUNK_BYTES, 10))]
"""In order of writing, on a clock that goes back."""


@pytest.fixture
def written(tmp_path):
    """A file with two topics, large and small messages, and whatever else a file may hold."""
    path = tmp_path / "written.mcap"
    with path.open("xb") as file:
        writer = McapWriter(file, HEADER)
        writer.add_attachment("rig.toml", b"x = 1")
        writer.add_channel(THING, THINGS)
        writer.add_channel(None, BARE)
        for m in SMALL:
            writer.add_message(m.channel_id, m.sequence, m.log_time, m.publish_time, m.data)
        writer.flush()
        writer.flush()  # nothing waits: no chunk is written
        for m in LARGE:
            writer.add_message(m.channel_id, m.sequence, m.log_time, m.publish_time, m.data)
        writer.finish()
    return path


def test_the_mcap_library_finds_by_our_index_what_was_written(written):
    with written.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        attached = [(attachment.name, attachment.data[:6]) for attachment in reader.iter_attachments()]
        things, bare = ([message for *_, message in reader.iter_messages([topic])] for topic in ("/things", "/bare"))
        by_time = [message.log_time for *_, message in reader.iter_messages(starting_at=98, ending_before=101)]
    assert attached == [(HEADER_FILE, b'{"sche'), ("rig.toml", b"x = 1")]
    assert (things, bare) == (SMALL, LARGE[::-1])
    assert by_time == [98, 98, 99, 99, 100, 100]


def test_the_index_of_a_chunk_leads_a_viewer_to_each_message(written):
    chunk, found = b"", 0
    for record in StreamReader(io.BytesIO(written.read_bytes()), emit_chunks=True).records:
        if isinstance(record, Chunk):
            chunk = zstandard.decompress(record.data)
        elif isinstance(record, MessageIndex):
            for log_ns, offset in record.records:
                assert struct.unpack_from("<BxxxxxxxxHxxxxQ", chunk, offset) == (
                    Opcode.MESSAGE,
                    record.channel_id,
                    log_ns,
                )
                found += 1
    assert found == len(SMALL) + len(LARGE)


def copied(path, *sources, channels=()):
    with path.open("xb") as file:
        writer = McapWriter(file, HEADER)
        for channel in channels:
            writer.add_channel(None, channel)
        for source in sources:
            writer.copy_file(source)
        writer.finish()
    return path


def test_the_messages_of_other_files_are_copied_as_they_are(written, tmp_path):
    copy = copied(tmp_path / "copy.mcap", written, written)
    assert [message for *_, message in McapFile(copy).sound().messages()] == 2 * [*SMALL, *LARGE]
    with copy.open("rb") as file:
        by_index = [m.log_time for *_, m in make_reader(file, validate_crcs=True).iter_messages(["/bare"])]
    assert by_index == [98, 98, 99, 99, 100, 100]


def test_a_file_that_numbers_its_topics_otherwise_is_not_merged(written, tmp_path):
    with pytest.raises(SessionDamaged, match="gives /things the channel number of /other"):
        copied(tmp_path / "copy.mcap", written, channels=[Channel(1, "/other", "json", {}, 0)])
