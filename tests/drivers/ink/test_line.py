from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink.port import crc16
from brushloop.drivers.ink.station import MAX_LINE_BYTES, Line, Reply, find_reply, number_of, seal, unseal
from brushloop.drivers.sim.instruments.ink import StationFirmware

DOC = Path(__file__).parents[3] / "docs" / "ink-station.md"
THOROUGH = settings(max_examples=10 * settings.default.max_examples, deadline=None)
SOME = settings(max_examples=100, deadline=None)
TEXTS = st.text(st.characters(min_codepoint=32, max_codepoint=126, exclude_characters="*"), max_size=60)
NUMBERS = st.integers(0, 999)


def test_the_crc_is_the_published_one():
    assert crc16(b"123456789") == 0x4B37
    assert crc16(b"") == 0xFFFF


def test_every_line_of_the_documented_transcript_is_sound():
    lines = re.findall(r"^    [<>] (.+)$", DOC.read_text(), re.MULTILINE)
    assert len(lines) == 12
    for line in lines:
        parsed = unseal(line.encode())
        assert seal(parsed.number, parsed.text) == line.encode() + b"\n"


@SOME
@given(NUMBERS, TEXTS)
def test_a_sealed_line_comes_back(number: int, text: str):
    assert unseal(seal(number, text)) == Line(number, text)


@THOROUGH
@given(st.binary(max_size=MAX_LINE_BYTES + 20))
@example(b"000 \xd9\xa3*FFFF\n")
@example(b"")
def test_any_bytes_are_a_line_or_a_protocol_violation(data: bytes):
    try:
        line = unseal(data)
    except ProtocolViolation:
        return
    assert unseal(seal(line.number, line.text)) == line


@SOME
@given(NUMBERS, TEXTS, st.data())
def test_a_line_with_any_one_byte_changed_never_says_something_else(number: int, text: str, data: st.DataObject):
    sound = seal(number, text)
    at = data.draw(st.integers(0, len(sound) - 1))
    damaged = sound[:at] + bytes([data.draw(st.integers(0, 255))]) + sound[at + 1 :]
    try:
        assert unseal(damaged) == Line(number, text)
    except ProtocolViolation:
        assert damaged != sound


@THOROUGH
@given(st.binary(max_size=300), NUMBERS)
def test_any_bytes_hold_a_reply_or_none(data: bytes, number: int):
    found = find_reply(data, number)
    assert found is None or isinstance(found, Reply)


@SOME
@given(st.binary(max_size=60), NUMBERS, st.integers(0, 30))
def test_a_reply_is_found_after_any_noise_and_not_before_it_is_whole(noise: bytes, number: int, cut: int):
    reply = seal(number, "ok 0.730")
    whole = noise + b"\n" + reply
    assert find_reply(whole[: len(whole) - 1 - cut % len(reply)], number) is None
    assert find_reply(whole, number) == Reply(("0.730",))


def test_the_reply_to_another_request_is_passed_over():
    assert find_reply(seal(4, "ok 1.0") + seal(5, "err 4 reservoir is empty"), 5) == Reply((), 4, "reservoir is empty")


@pytest.mark.parametrize("text", ["dose 1.000", "okay", "err", "err 0 fine", "err x", "OK", ""])
def test_a_sound_line_that_is_no_reply_is_passed_over(text: str):
    assert find_reply(seal(7, text), 7) is None


@pytest.mark.parametrize(("number", "text"), [(-1, "ok"), (1000, "ok"), (1, "a*b"), (1, "a\nb"), (1, "x" * 90)])
def test_what_cannot_be_a_line_is_not_sent(number: int, text: str):
    with pytest.raises(ValueError, match="not a line"):
        seal(number, text)


@SOME
@given(st.one_of(TEXTS, st.floats().map(str), st.integers().map(str)))
@example("nan")
@example("1_0")
@example("1e5")
@example("٣")
def test_a_number_is_a_plain_decimal(word: str):
    try:
        value = number_of(word)
    except ProtocolViolation:
        return
    assert 0.0 <= value < 1e6


@SOME
@given(
    st.lists(st.one_of(st.binary(max_size=40).map(lambda b: b + b"\n"), st.builds(seal, NUMBERS, TEXTS)), max_size=4)
)
def test_the_simulated_station_survives_any_bytes(lines: list[bytes]):
    firmware = StationFirmware()
    buffer = bytearray(b"".join(lines))
    while (request := firmware.take(buffer)) is not None:
        reply = firmware.answer(request)
        assert reply is None or unseal(reply).number == unseal(request).number
    assert not buffer
