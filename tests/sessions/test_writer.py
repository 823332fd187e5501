"""One file of a session: all that was written is in it, as the mcap library writes it, and a failing disk is heard."""

import errno
import hashlib
import io
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from brushloop.sessions import mcap_writer
from brushloop.sessions.errors import SessionDamaged, SessionError
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


@pytest.mark.parametrize("failing", ["fsync", "rename"])
def test_an_error_of_the_last_steps_is_a_session_error(make, path, monkeypatch, failing):
    def fail(*_):
        raise OSError(errno.EIO, "Input/output error")

    writer = SegmentWriter(path, make.header)
    monkeypatch.setattr(*((os, "fsync", fail) if failing == "fsync" else (Path, "rename", fail)))
    with pytest.raises(SessionError, match="Input/output error"):
        writer.finish()
    assert [p.name for p in path.parent.iterdir()] == [f"{path.name}.part"]


def test_a_disk_that_does_not_keep_up_is_heard(make, path, monkeypatch):
    monkeypatch.setattr(mcap_writer, "QUEUE_LIMIT", 1)
    writer = SegmentWriter(path, make.header)
    noise = np.random.default_rng(0).bytes(1_000_000)
    with pytest.raises(SessionError, match="1 messages wait: the disk does not keep up"):
        write_all(writer, (make.still(number, noise) for number in range(1000)))
    writer.abandon()


HEADER = Make.header
THING, THINGS = Schema(1, b"{}", "jsonschema", "Thing"), Channel(1, "/things", "json", {}, 1)
BARE = Channel(2, "/bare", "", {}, 0)


def theirs(file):
    writer = Writer(
        file,
        chunk_size=CHUNK_BYTES,
        compression=CompressionType.ZSTD,
        enable_data_crcs=True,
        use_summary_offsets=False,
    )
    writer.start(profile="", library=HEADER.software)
    writer.add_attachment(0, 0, HEADER_FILE, "application/json", HEADER.model_dump_json().encode())

    def add_channel(schema, channel):
        if schema is not None:
            writer.register_schema(schema.name, schema.encoding, schema.data)
        writer.register_channel(channel.topic, channel.message_encoding, channel.schema_id)

    def add_message(channel_id, sequence, log_ns, publish_ns, data):
        writer.add_message(channel_id, log_ns, data, publish_ns, sequence)

    def attach(name, data):
        writer.add_attachment(0, 0, name, "application/toml", data)

    return writer, attach, add_channel, add_message


def ours(file):
    writer = McapWriter(file, HEADER)
    return writer, writer.add_attachment, writer.add_channel, writer.add_message


def written(begin):
    """A file with two topics, large and small messages, a clock that goes back, and whatever else a file may hold."""
    file = io.BytesIO()
    writer, attach, add_channel, add_message = begin(file)
    attach("rig.toml", b"x = 1")
    add_channel(THING, THINGS)
    add_channel(None, BARE)
    for number in range(500):
        add_message(THINGS.id, number, number, number + 1, b"{}")
    writer.flush()
    writer.flush()  # nothing waits: no chunk is written
    for number, size in enumerate((0, CHUNK_BYTES, 10)):
        add_message(BARE.id, 2**32 - 1, 100 - number, 0, bytes(size))
    writer.finish()
    file.seek(0)
    return file


@pytest.mark.parametrize("topic", ["/things", "/bare"])
def test_the_mcap_library_finds_by_our_index_what_it_finds_by_its_own(topic):
    def found(file):
        reader = make_reader(file, validate_crcs=True)
        assert [(a.name, a.data[:6]) for a in reader.iter_attachments()] == [
            (HEADER_FILE, b'{"sche'),
            ("rig.toml", b"x = 1"),
        ]
        return [asdict(message) for _, _, message in reader.iter_messages([topic])]

    assert found(written(ours)) == found(written(theirs))


def copied(path, *sources, channels=()):
    with path.open("xb") as file:
        writer = McapWriter(file, HEADER)
        for channel in channels:
            writer.add_channel(None, channel)
        for source in sources:
            writer.copy_file(source)
        writer.finish()


def test_the_messages_of_other_files_are_copied_as_they_are(tmp_path):
    source, copy = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    source.write_bytes(written(theirs).getvalue())
    copied(copy, source, source)

    def messages_of(path):
        return [
            (c.topic, m.sequence, m.log_time, m.publish_time, m.data) for _, c, m in McapFile(path).sound().messages()
        ]

    assert messages_of(copy) == 2 * messages_of(source)
    with copy.open("rb") as file:
        by_index = [m.log_time for _, _, m in make_reader(file, validate_crcs=True).iter_messages(["/bare"])]
    assert by_index == [98, 98, 99, 99, 100, 100]


def test_a_file_that_numbers_its_topics_otherwise_is_not_merged(tmp_path):
    source = tmp_path / "source.mcap"
    source.write_bytes(written(theirs).getvalue())
    with pytest.raises(SessionDamaged, match="has /things under the number of /other"):
        copied(tmp_path / "copy.mcap", source, channels=[Channel(1, "/other", "json", {}, 0)])
