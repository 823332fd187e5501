"""Damage at every record boundary and at random places of a session: repair gives back what is intact, and says so.

Held against the bytes as they were before the damage: nothing comes back changed, a stroke whose own files were not
hit comes back whole, and a repair that calls itself lossless gave back every message.
"""

import os
import random
import shutil
import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from brushloop.sessions.journal.journal import JOURNAL_NAME
from brushloop.sessions.records import Topic
from brushloop.sessions.repair.repair import repair_session
from brushloop.sessions.repair.verify import verify_session
from brushloop.sessions.store import SessionStore

PLACES = 30
"""Random places in each of the two sessions, open and closed. The soak has more, and each boundary both ways."""
EVERY = 2
"""One record boundary of so many is damaged here, cut there or with a bit flipped in turn."""


@dataclass
class Whole:
    """A session before the damage."""

    folder: Path
    closed: bool
    messages: Counter
    sizes: dict[str, int]


@pytest.fixture(scope="module", params=["open", "closed"])
def whole(request, make, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param) / "2026-01-02-grid-01"
    store = make.store(folder)
    make.collect(store)
    store.release()
    twin = tmp_path_factory.mktemp("twin") / folder.name
    shutil.copytree(folder, twin)
    store = SessionStore(folder if request.param == "closed" else twin, None, make.clock())
    messages = make.messages(store.close())
    store.release()
    sizes = {p.name: p.stat().st_size for p in sorted(folder.iterdir()) if p.suffix != ".lock" and p.stat().st_size}
    return Whole(folder, request.param == "closed", messages, sizes)


def record_boundaries(path):
    """Offsets at which a record of an MCAP file, or a line of a journal, begins."""
    data = path.read_bytes()
    if ".mcap" not in path.name:
        return [0, *(at + 1 for at, byte in enumerate(data) if byte == 10)][:-1]
    at, found = 8, [0]
    while at < len(data) - 8:
        found.append(at)
        opcode, length = struct.unpack_from("<BQ", data, at)
        at += 9 + length
    assert opcode == Opcode.FOOTER
    return [*found, len(data) - 8]


def places(whole, chosen, count, both_ways):
    """(file, offset, bit or None to cut there): each boundary `both_ways`, or some cut or flipped; then random."""
    for file, name in enumerate(whole.sizes):
        boundaries = record_boundaries(whole.folder / name)
        if both_ways:
            for at in boundaries:
                yield name, at, None
                yield name, at, chosen.randrange(8)
            continue
        for number, at in enumerate(boundaries[file % EVERY :: EVERY]):
            yield name, at, None if number % 2 == 0 else chosen.randrange(8)
    names, sizes = list(whole.sizes), list(whole.sizes.values())
    for _ in range(count):
        [name] = chosen.choices(names, sizes)
        at = chosen.randrange(whole.sizes[name])
        yield name, at, chosen.choice([None, chosen.randrange(8)])


def damaged_copy(whole, folder, name, at, bit):
    """The session with one file cut at `at`, or one bit of it flipped; returns the bytes of that file."""
    folder.mkdir(parents=True)
    for other in whole.sizes:
        if other not in (name, JOURNAL_NAME):
            os.link(whole.folder / other, folder / other)
    if name != JOURNAL_NAME:
        shutil.copy(whole.folder / JOURNAL_NAME, folder)
    data = bytearray((whole.folder / name).read_bytes())
    if bit is None:
        del data[at:]
    else:
        data[at] ^= 1 << bit
    (folder / name).write_bytes(data)
    return bytes(data)


def strokes_of(messages):
    """stroke's still -> (the message, the message of its still)."""
    stills = {message[1]: message for message in messages if message[0] == Topic.STILL}
    return {message[1]: (message, stills.get(message[1])) for message in messages if message[0] == Topic.STROKE}


def check(make, whole, folder, name, at, bit):
    data = damaged_copy(whole, folder, name, at, bit)
    report = repair_session(folder, make.clock())
    verdict = verify_session(folder)
    assert verdict.sound, verdict.findings
    assert report.lossless == (report.lost == [])

    kept = [path.read_bytes() for path in folder.iterdir() if path.name.startswith(name)]
    assert any(content == data or (name == JOURNAL_NAME and content.startswith(data)) for content in kept) or (
        name == JOURNAL_NAME and any(data[data.rfind(b"\n") + 1 :].hex().encode() in content for content in kept)
    ), "the damaged bytes are gone"

    final = folder / f"{folder.name}.mcap"
    if not whole.closed or not final.exists():
        store = SessionStore(folder, None, make.clock())
        final = store.close()
        store.release()
    messages = make.messages(final)
    assert not messages - whole.messages, "something came back changed"
    if report.lossless:
        assert messages == whole.messages
    before, after = strokes_of(whole.messages), strokes_of(messages)
    for number, pair in after.items():
        assert pair == before[number]
    hit = {stroke for stroke in before if f"H13-a05-r{stroke:02d}" in name_of_step(whole, name)}
    assert set(before) - hit <= set(after), "an intact stroke was not given back"
    return report.lossless


def name_of_step(whole, name):
    """The stroke whose file was hit, empty for any other file; never where the merged file holds it as well."""
    serial = name.split("-")[0]
    if whole.closed or not serial.isdigit() or "-capture-" not in name:
        return ""
    return f"H13-a05-r{(int(serial) - 3) // 2:02d}"


def run(make, whole, root, chosen, count, *, both_ways):
    ends = Counter()
    for number, (name, at, bit) in enumerate(places(whole, chosen, count, both_ways)):
        folder = root / str(number) / whole.folder.name
        try:
            ends[check(make, whole, folder, name, at, bit)] += 1
        except Exception as error:
            error.add_note(f"{name} {'cut' if bit is None else f'bit {bit} flipped'} at {at}")
            raise
        shutil.rmtree(folder)
    return ends


@pytest.mark.timeout(600)  # hundreds of repairs, on a machine that may be busy
def test_whatever_is_damaged_the_rest_is_given_back(make, whole, tmp_path):
    ends = run(make, whole, tmp_path, random.Random(11), PLACES, both_ways=False)
    assert ends[True] > 20, "hardly a repair was lossless"
    assert whole.closed or ends[False] > 20, "hardly a repair was lossy"


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(10))
def test_damage_at_many_times_as_many_places(make, whole, tmp_path, seed):
    run(make, whole, tmp_path, random.Random(seed), 1000, both_ways=True)
