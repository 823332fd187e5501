"""Bytes and whole lines of a session damaged at random: what is intact comes back once, and nothing false is sound.

What is intact is computed from the session as it was before, by the mcap library alone: a message is intact if
its chunk was not hit, in its step's file or in the merged one.
"""

import io
import json
import random
import shutil
import struct
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk

from brushloop.sessions.errors import InputError, SessionDamaged
from brushloop.sessions.events import PressResult, ZeroTouchResult
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Topic
from brushloop.sessions.repair import repair_session
from brushloop.sessions.store import SessionStore
from brushloop.sessions.verify import verify_session

STROKES = 3
QUICK = 34
"""Damages of each of the three kinds of session. The soak has ten times as many."""
HEADER_BYTES = 1500
"""More than the header of a file with its notes."""


@dataclass
class Whole:
    """A session before the damage, and what its files hold where."""

    folder: Path
    foreign: list[bytes]
    """Lines of another session."""
    lone: bool
    messages: Counter
    starts: dict[str, list] = field(default_factory=dict)
    """File -> (first byte, byte behind the start) of each record, then of the index."""
    chunks: dict[str, list] = field(default_factory=dict)
    """File -> (first byte, byte behind the last, messages) of each chunk."""


@dataclass
class Damage:
    """What was done to a copy."""

    words: list[str] = field(default_factory=list)
    hit: dict[str, list] = field(default_factory=lambda: defaultdict(list))
    """File -> ranges of bytes that are not what they were."""


def collect(make, folder):
    """Set-up done twice, a cut press, a change of sheet and a second process, as in a real session."""
    store = make.store(folder)
    make.take(store, "touch", [make.pose(1)], ZeroTouchResult(method="taught", touch_z_mm=1.0))
    make.collect(store, STROKES - 1)
    store.fresh_sheet()
    store.release()
    store = SessionStore(folder, make.clock())
    make.take(store, "touch", [make.pose(2)], ZeroTouchResult(method="taught", touch_z_mm=1.1))
    pressed = PressResult(press=make.press("H13-a05-r09", sheet=1, patch=0))
    make.take(store, "H13-a05-r09 press", [make.pose(900 + n) for n in range(5)], pressed, 0)
    shown = [make.still(9), make.stroke(9)]
    make.take(store, "H13-a05-r09 capture", shown, make.captured("H13-a05-r09", 9))
    return store


@pytest.fixture(scope="module", params=["open", "closed", "lone"])
def whole(request, make, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param) / "2026-01-02-grid-01"
    store = collect(make, folder)
    journal = (folder / JOURNAL_NAME).read_bytes()
    messages = make.messages(store.close())
    store.release()
    if request.param == "open":
        (folder / f"{folder.name}.mcap").unlink()
        (folder / JOURNAL_NAME).write_bytes(journal)
    other = make.session(tmp_path_factory.mktemp("other") / "2026-01-02-other-01", session_id="2026-01-02-other-01")
    foreign = (other / JOURNAL_NAME).read_bytes().splitlines(keepends=True)
    if request.param == "lone":
        for path in folder.iterdir():
            if path.name != f"{folder.name}.mcap":
                path.unlink()
    made = Whole(folder, foreign, request.param == "lone", messages)
    made.starts = {path.name: starts_of(path) for path in folder.glob("*.mcap")}
    made.chunks = {path.name: chunks_of(path) for path in folder.glob("*.mcap")}
    return made


def starts_of(path):
    """Opcode and length of every record up to the end of the data, in one piece each; the rest is the index."""
    data, at, starts = path.read_bytes(), 8, []
    while not starts or data[starts[-1][0]] != Opcode.DATA_END:
        starts.append((at, at + 9))
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    return [*starts, (at, len(data))]


def hits(ranges, start, end):
    return any(start < b and a < end for a, b in ranges)


def chunks_of(path):
    data = path.read_bytes()
    with path.open("rb") as file:
        indexes = make_reader(file).get_summary().chunk_indexes
    found = []
    topics = {}
    for index in indexes:
        start = index.chunk_start_offset
        _opcode, length = struct.unpack_from("<BQ", data, start)
        stream = ReadDataStream(io.BytesIO(data[start + 9 : start + 9 + length]))
        messages = set()
        for record in breakup_chunk(Chunk.read(stream)):
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                topic = topics[record.channel_id]
                name = json.loads(record.data)["stroke_id"] if topic == Topic.STROKE else ""
                messages.add((topic, record.sequence, name))
        found.append((start, start + 9 + length, messages))
    return found


def intact_strokes(whole, damage):
    """Strokes of which one file holds both the record and its photograph outside of what was hit."""
    names = set()
    for name, chunks in whole.chunks.items():
        there = set()
        for start, end, messages in chunks:
            if not hits(damage.hit[name], start, end) and findable(whole, name, start, damage.hit[name]):
                there |= messages
        stills = {number for topic, number, _ in there if topic == Topic.STILL}
        names |= {stroke for topic, number, stroke in there if topic == Topic.STROKE and number in stills}
    return names


def findable(whole, name, at, ranges):
    """Whether the index, or an unbroken row of records, leads to this place."""
    *starts, index = whole.starts[name]
    return not hits(ranges, *index) or not any(hits(ranges, *start) for start in starts if start[0] < at)


def bytes_of(whole, folder, chosen, damage):
    """One bit, or everything behind a place, of a file."""
    paths = [path for path in sorted(folder.iterdir()) if path.stat().st_size and path.name in whole.chunks]
    path = chosen.choice(paths if whole.lone else [*paths, folder / JOURNAL_NAME])
    data = bytearray(path.read_bytes())
    at = chosen.randrange(len(data))
    if chosen.random() < 0.3:
        del data[at:]
        damage.hit[path.name].append((at, 1 << 60))
        damage.words.append(f"{path.name} cut at {at}")
    else:
        data[at] ^= 1 << chosen.randrange(8)
        damage.hit[path.name].append((at, at + 1))
        damage.words.append(f"{path.name} a bit at {at}")
    path.write_bytes(data)


def exchanged(whole, folder, chosen, damage):
    """Two steps' files under each other's names, or one that is gone."""
    one, other = chosen.sample(sorted(path.name for path in folder.glob("0*.mcap")), 2)
    if chosen.random() < 0.3:
        (folder / one).unlink()
        damage.hit[one].append((0, 1 << 60))
        damage.words.append(f"{one} gone")
        return
    (folder / one).rename(folder / "between")
    (folder / other).rename(folder / one)
    (folder / "between").rename(folder / other)
    damage.words.append(f"{one} and {other} exchanged")


def lines_of(whole, folder, chosen, damage):
    """Whole lines taken out, doubled, exchanged, put in from another session, or edited."""
    path = folder / JOURNAL_NAME
    lines = path.read_bytes().splitlines(keepends=True)
    kind = chosen.choice(["delete", "double", "exchange", "foreign", "edit"])
    at = chosen.randrange(len(lines))
    if kind == "delete":
        del lines[at : at + chosen.choice([1, 1, 1, 2, 5])]
    elif kind == "double":
        lines.insert(chosen.randrange(len(lines) + 1), lines[at])
    elif kind == "exchange":
        other = chosen.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == "foreign":
        lines.insert(at, chosen.choice(whole.foreign))
    else:
        at = chosen.randrange(len(lines) - 1)
        lines[at] = edited(lines[at], chosen)
    damage.words.append(f"line {at + 1}: {kind}")
    path.write_bytes(b"".join(lines))


def edited(line, chosen):
    """Another digit somewhere in what the line says, its CRC as it was."""
    end = line.rindex(b',"crc":')
    at = chosen.choice([at for at, byte in enumerate(line[:end]) if chr(byte).isdigit()])
    digit = str((line[at] - 48 + chosen.randrange(1, 10)) % 10).encode()
    return line[:at] + digit + line[at + 1 :]


def may_be_sound(whole, before):
    """Where nothing is damaged: all as it was, but that the journal may end earlier, as after a kill."""
    files = contents(whole.folder)
    if whole.lone:
        return before == files
    journal = files.pop(JOURNAL_NAME)
    steps = {name: data for name, data in before.items() if name != JOURNAL_NAME}
    return steps == files and journal.startswith(before[JOURNAL_NAME])


def read_of(path):
    """All that a reader gets out of a recording; None where it is refused in one line that names the file."""
    try:
        recording = Recording(path)
        captures = [(capture.stroke, capture.still_png) for capture in recording.captures()]
        rig = recording.attachment("rig.toml")
    except (InputError, SessionDamaged) as error:
        message = str(error)
    else:
        return recording.header, captures, rig
    assert message.startswith(str(path))
    assert "\n" not in message
    return None


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != ".lock"}


def damaged_copy(whole, root, chosen, damage):
    folder = root / whole.folder.name
    shutil.copytree(whole.folder, folder)
    ways = [bytes_of] if whole.lone else [lines_of] * 5 + [bytes_of] * 4 + [exchanged]
    for way in chosen.choice([[chosen.choice(ways)]] * 3 + [[ways[0], ways[0]], [bytes_of, bytes_of]]):
        way(whole, folder, chosen, damage)
    return folder


def judged(make, whole, folder, damage):
    before = contents(folder)
    if whole.lone:
        name = f"{folder.name}.mcap"
        assert read_of(folder / name) in (None, read_of(whole.folder / name)), "something changed was read"
    verdict = verify_session(folder)
    assert not verdict.sound or may_be_sound(whole, before), "verify says sound"
    assert contents(folder) == before, "verify changed something"
    try:
        report = repair_session(folder, make.clock())
    except SessionDamaged:
        header = whole.starts[f"{folder.name}.mcap"][1][0]
        assert whole.lone, "a session can be rebuilt"
        assert hits(damage.hit[f"{folder.name}.mcap"], 0, header + HEADER_BYTES), "the header was whole"
        assert contents(folder) == before
        return "refused"
    assert repair_session(folder, make.clock()).did == [], "a second repair did something"
    again = verify_session(folder)
    assert again.sound, again.findings
    kept = [path.read_bytes() for path in folder.iterdir() if path.is_file()]
    for name, data in before.items():
        assert any(data in other for other in kept), f"the bytes of {name} are gone"
    final = folder / f"{folder.name}.mcap"
    if again.state == "open":
        store = SessionStore(folder, make.clock())
        final = store.close()
        store.release()
    names = make.stroke_names(final)
    assert len(names) == len(set(names)), "a stroke came twice"
    messages = make.messages(final)
    assert not messages - whole.messages, "something came back changed"
    gone = intact_strokes(whole, damage) - set(names)
    assert not gone, f"intact strokes were given up: {gone}; {report}"
    for name in set(intact_strokes(whole, Damage())) - set(names):
        assert whole.lone or any(name in line for line in report.lost), f"{name} is not named: {report.lost}"
    assert messages == whole.messages or report.lost
    return "lossless" if not report.lost else "lossy"


def run(make, whole, root, seed, count):
    ends = Counter()
    chosen = random.Random(seed)
    for number in range(count):
        place, damage = root / str(number), Damage()
        try:
            folder = damaged_copy(whole, place, chosen, damage)
            ends[judged(make, whole, folder, damage)] += 1
        except Exception as error:
            error.add_note(f"seed {seed}, number {number}: {'; '.join(damage.words)}")
            raise
        shutil.rmtree(place)
    return ends


def test_no_damage_gives_up_what_is_intact_or_makes_it_twice(make, whole, tmp_path):
    ends = run(make, whole, tmp_path, 3, QUICK)
    assert ends["lossless"] + ends["lossy"] > QUICK / 2


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", range(10))
def test_a_thousand_damages(make, whole, tmp_path, seed):
    """Ten seeds of 34 each, of an open and of a closed session, and of a recording alone."""
    assert run(make, whole, tmp_path, seed, QUICK).total() == QUICK
