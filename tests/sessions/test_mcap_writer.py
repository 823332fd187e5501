"""Our writer of MCAP files beside the mcap library's: the same records in the same order."""

import io
from dataclasses import asdict

import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import CompressionType, Writer

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.mcap_file import open_mcap
from brushloop.sessions.mcap_writer import CHUNK_BYTES, McapWriter

PLACES = {"chunk_length", "chunk_start_offset", "compressed_size", "message_index_offsets"}
"""What depends on how well a chunk was compressed; the library compresses at another level."""


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
    writer.start(profile="", library="test")

    def add_channel(schema, channel):
        if schema is not None:
            writer.register_schema(schema.name, schema.encoding, schema.data)
        writer.register_channel(channel.topic, channel.message_encoding, channel.schema_id)

    def add_message(channel_id, sequence, log_ns, publish_ns, data):
        writer.add_message(channel_id, log_ns, data, publish_ns, sequence)

    def attach(name, media_type, data):
        writer.add_attachment(0, 0, name, media_type, data)

    return writer, attach, add_channel, add_message


def ours(file):
    writer = McapWriter(file, "test")
    return writer, writer.add_attachment, writer.add_channel, writer.add_message


def written(begin):
    """A file with two topics, large and small messages, a clock that goes back, and whatever else a file may hold."""
    file = io.BytesIO()
    writer, attach, add_channel, add_message = begin(file)
    writer.add_metadata("note", {"a": "1"})
    attach("rig.toml", "application/toml", b"x = 1")
    add_channel(THING, THINGS)
    add_channel(None, BARE)
    for number in range(500):
        add_message(THINGS.id, number, number, number + 1, b"{}")
    writer.flush()
    writer.flush()  # nothing waits: no chunk is written
    for number, size in enumerate((0, CHUNK_BYTES, 10)):
        add_message(BARE.id, 2**32 - 1, 100 - number, 0, bytes(size))
    writer.add_metadata("done", {})
    writer.finish()
    file.seek(0)
    return file


def records(file):
    for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
        values = asdict(record)
        if isinstance(record, Chunk):
            stream, size = get_chunk_data_stream(record, validate_crc=True)
            values["data"] = stream.read(size)
        if isinstance(record, ChunkIndex):
            values = {name: value for name, value in values.items() if name not in PLACES}
        values.pop("data_section_crc", None)
        if "offset" in values or "group_start" in values or "summary_start" in values:
            continue  # places in the file again; the reader below finds everything by them
        yield type(record).__name__, values


def test_the_same_calls_write_the_same_records_as_the_mcap_library():
    assert list(records(written(ours))) == list(records(written(theirs)))


@pytest.mark.parametrize("topic", ["/things", "/bare"])
def test_the_mcap_library_finds_by_our_index_what_it_finds_by_its_own(topic):
    def found(file):
        reader = make_reader(file, validate_crcs=True)
        assert [(a.name, a.data) for a in reader.iter_attachments()] == [("rig.toml", b"x = 1")]
        assert [m.name for m in reader.iter_metadata()] == ["note", "done"]
        return [asdict(message) for _, _, message in reader.iter_messages([topic])]

    assert found(written(ours)) == found(written(theirs))


def copied(path, *sources, channels=()):
    with path.open("xb") as file:
        writer = McapWriter(file, "test")
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
        return [(c.topic, m.sequence, m.log_time, m.publish_time, m.data) for _, c, m in open_mcap(path).messages()]

    assert messages_of(copy) == 2 * messages_of(source)
    with copy.open("rb") as file:
        by_index = [m.log_time for _, _, m in make_reader(file, validate_crcs=True).iter_messages(["/bare"])]
    assert by_index == [98, 98, 99, 99, 100, 100]


def test_a_file_that_numbers_its_topics_otherwise_is_not_merged(tmp_path):
    source = tmp_path / "source.mcap"
    source.write_bytes(written(theirs).getvalue())
    with pytest.raises(SessionDamaged, match="has /things under the number of /other"):
        copied(tmp_path / "copy.mcap", source, channels=[Channel(1, "/other", "json", {}, 0)])
