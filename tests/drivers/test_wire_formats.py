"""Every wire format of the devices: the published bytes, and that any bytes in any pieces are values or a refusal."""

from __future__ import annotations

import json
import math
import random
import re
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cbor2
import pytest

from brushloop.drivers.arcs import wire
from brushloop.drivers.arcs.telemetry import decode_message, encode_sample, outputs_of
from brushloop.drivers.arcs.wire import (
    FACTORY_LOGIN_TOKEN,
    PING,
    Decoder,
    answer_in,
    encode,
    encode_bare_request,
    encode_request,
    encode_short,
    numbers,
)
from brushloop.drivers.errors import DeviceError, ProtocolViolation
from brushloop.drivers.force import sri_m8123
from brushloop.drivers.force.sri_m8123 import COMMAND_ID, RoundAssembler, Wrench, encode_round
from brushloop.drivers.ink import pump, station
from brushloop.drivers.ink.port import crc16

DOC = Path(__file__).parents[2] / "docs" / "ink-station.md"
POSE = [0.4, -0.13, 0.2, 3.14, 0.0, 1.57]
MOVE = {"v": 0.25, "a": 1.2, "duration": 0.0, "blend_radius": 0.0, "pose": POSE}
REPLIES = [
    b'{"id": "a", "jsonrpc": "2.0", "result": 24000}',
    b'{"id":7,"jsonrpc":"2.0","result":[0.25,-0.23,0.26,3.14,0.0,1.57,{"b":null},NaN,1e999]}',
    b'{"id":"a","jsonrpc":"2.0","error":{"code":-32601,"message":"method not found: \\"a\\\\b\\u00e9\\"}]"}}',
    json.dumps({"id": "a", "result": [{"code": 30047, "args": ["é[{", "\\"]}]}, ensure_ascii=False).encode(),
]
START = pump.write_register(1, 4, 1)
WRENCH: Wrench = (1.0, -2.0, 3.5, 0.25, -0.5, 0.125)
ROUND = b"".join(can_id.to_bytes(2) + data for can_id, data in encode_round(WRENCH))

_NASTY = (
    *(b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xff\xff", b"\x9b" + b"\xff" * 8, b"\x5b" + b"\x7f" * 8),
    *(b"NaN", b"Infinity", b"1e999", b"-0", b"9" * 400, b"0x1", b"1_0", b"true"),
    *(b"[" * 70, b'{"a":' * 70, b"\x81" * 40, b"\xa1\x61a" * 20, b"]" * 70),
    *(b"\0", b"\x80", b"\n", b"\r", b" ", b'"', b"\\", b"{", b"}", b"[", b"]", b",", b":", b"*"),
)


def hostile(valid: Sequence[bytes], count: int) -> Iterator[bytes]:
    """Valid messages cut off at every byte, `count` with one to four injuries, and noise."""
    rng = random.Random(1)
    yield from (message[:end] for message in valid for end in range(len(message) + 1))
    for _ in range(count):
        data = bytearray(rng.choice(valid))
        for _ in range(rng.randint(1, 4)):
            at = rng.randint(0, len(data))
            end = at + rng.randint(1, 8)
            flipped = bytes(byte ^ 1 << rng.randrange(8) for byte in data[at : at + 1])
            other, noise, nasty = rng.choice(valid)[rng.randint(0, at) :], rng.randbytes(4), rng.choice(_NASTY)
            piece = rng.choice((b"", flipped, data[at:end] * rng.randint(1, 3), other, noise, nasty))
            data[at : rng.choice((at, at + len(flipped), end))] = piece
        yield bytes(data)
    yield from (rng.randbytes(rng.randint(0, 80)) for _ in range(count // 10))


def pieces(stream: bytes, rng: random.Random) -> list[list[bytes]]:
    """The stream whole, in a few pieces, and byte by byte."""
    cuts = sorted(rng.randint(0, len(stream)) for _ in range(rng.randint(0, 5)))
    few = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    return [[stream], few, [stream[at : at + 1] for at in range(len(stream))]]


# ---------------------------------------------------------------- published bytes

LOGIN = f"__login__\naubo\n{FACTORY_LOGIN_TOKEN}\n0.24.0\n".encode()
PUBLISHED: list[tuple[bytes, bytes]] = [
    (
        encode(encode_request("xVoNsnVP-ERjD-powj", "SystemInfo.getInterfaceVersionCode", None)),
        bytes.fromhex("53 4f 46 01 00 00 00 59")
        + b'{"id":"xVoNsnVP-ERjD-powj","jsonrpc":"2.0","method":"SystemInfo.getInterfaceVersionCode"}',
    ),
    (
        encode_request("AHt2w5dt-hMOk-kk0M", "rob1.MotionControl.moveLine", MOVE),
        b'{"id":"AHt2w5dt-hMOk-kk0M","jsonrpc":"2.0","method":"rob1.MotionControl.moveLine","params":'
        b'{"a":1.2,"blend_radius":0.0,"duration":0.0,"pose":[0.4,-0.13,0.2,3.14,0.0,1.57],"v":0.25}}',
    ),
    (encode(LOGIN)[:8], bytes.fromhex("53 4f 46 01 00 00 00 63")),
    (
        encode_bare_request(7, "rob1.MotionControl.moveLine", MOVE),
        b'{"jsonrpc":"2.0","method":"rob1.MotionControl.moveLine",'
        b'"params":[[0.4,-0.13,0.2,3.14,0.0,1.57],1.2,0.25,0.0,0.0],"id":7}',
    ),
    (ROUND, bytes.fromhex("0291 0000803f 000000c0  0292 00006040 0000803e  0293 000000bf 0000003e")),
    (COMMAND_ID.to_bytes(2) + sri_m8123.START + sri_m8123.STOP, bytes.fromhex("0080 02 00")),
    (
        b"".join(Decoder().feed(bytes.fromhex("53 4f 46 01 00 00 00 02 4f 4b") + b"SOF\x00\x00\x05hello")),
        b"OKhello",
    ),
]


@pytest.mark.parametrize(("sent", "published"), PUBLISHED, ids=range(len(PUBLISHED)))
def test_the_bytes_are_the_published_ones(sent: bytes, published: bytes):
    assert sent == published


def test_every_line_of_the_ink_stations_documented_transcript_is_sound():
    lines = re.findall(r"^    [<>] (.+)$", DOC.read_text(), re.MULTILINE)
    assert len(lines) == 12
    for line in lines:
        assert (sealed := station.unseal(line.encode())) is not None
        assert station.seal(*sealed) == line.encode() + b"\n"
    assert crc16(b"123456789") == 0x4B37


@pytest.mark.parametrize(
    "refused",
    [
        lambda: encode_bare_request(1, "rob1.MotionControl.stopLine", {"acc": 1.0}),
        *(lambda v=v: numbers("getTcpPose", v, 3) for v in ("123", [1, 2], [1, 2, "3"], [1, 2, True], [1, 2, 10**400])),
    ],
)
def test_what_a_format_cannot_carry_is_refused(refused: Callable[[], object]):
    with pytest.raises(ValueError, match=r"stopLine|expected 3"):
        refused()


# ---------------------------------------------------------------- any bytes

Read = Callable[[bytes], object]
"""Raises `DeviceError` for what it refuses, and returns None for what it passes over."""


def joined(data: bytes) -> object:
    """The wrenches in a row of frames, each an id of two bytes and what it holds; then a sound round."""
    parts = RoundAssembler()
    frames = [(int.from_bytes(data[at : at + 2]), data[at + 2 : at + 10]) for at in range(0, len(data), 10)]
    wrenches = [wrench for frame in frames if (wrench := parts.feed(*frame, 0.0)) is not None]
    assert all(math.isfinite(value) and abs(value) <= 1000.0 for wrench in wrenches for value in wrench)
    assert [parts.feed(*frame, 7.0) for frame in encode_round(WRENCH)] == [None, None, WRENCH]
    return wrenches or None


LINES = [
    station.seal(5, text) for text in ("ok", "ok 0.730 1.250", "err 4 reservoir is empty", "ok nan inf 1e999", "hello")
]
LINES += [LINES[0] + LINES[1], b"\r\n" + LINES[2], station.seal(4, "ok 1.0") + LINES[1]]


def refusal_of(unit: int, code: int) -> bytes:
    """The exception reply of a pump that refuses a write."""
    return pump.seal(bytes([unit, 0x86, code]))


REFUSAL = refusal_of(1, 4)
FRAMES = [START, REFUSAL, pump.write_register(1, 1, 6000), refusal_of(2, 1), REFUSAL + START, START + REFUSAL]
VALUES: list[list[Any]] = [
    [0, POSE, POSE],
    [0, "Running", True, None, 5, -(2**63), 1.5e300, {"a": [1, {"b": "c"}]}],
    [100, {"chanel": 0, "frequency": 50.0, "segments": ["R1_actual_q"], "to_server": False, "trigger": 0}],
    [2**64 - 1, math.nan, math.inf, "é" * 20],
]
PUSHES = [cbor2.dumps(values) for values in VALUES] + [json.dumps(values).encode() for values in VALUES]
TAGGED = [cbor2.dumps([0, cbor2.CBORTag(tag, body)]) for tag in range(300) for body in ("1", b"1", 1, [1, 2], {"a": 1})]
SHARED = b"\x82\x00\xd8\x1c\x82\x01\xd8\x1d\x00"
"""A value that holds itself."""
GREETING = b'{"protocol":"rtde","version":1,"input":{"set_recipe":100},"output":{"R1_actual_TCP_pose":1021}}\n\n'
READERS: dict[str, tuple[Read, list[bytes], int]] = {
    "a reply": (lambda payload: answer_in(payload, "a", "getTcpPose"), REPLIES, 4000),
    "a push": (decode_message, PUSHES, 5000),
    "a greeting": (outputs_of, [GREETING, b'{"protocol":"rtde","output":{}}\n\n'], 4000),
    "rounds of the force board": (joined, [ROUND * 3], 2000),
}


@pytest.mark.parametrize(("read", "valid", "count"), READERS.values(), ids=READERS.keys())
def test_any_bytes_are_a_value_or_a_refusal(read: Read, valid: list[bytes], count: int):
    taken = 0
    for data in hostile(valid, count):
        try:
            taken += read(data) is not None
        except DeviceError:
            continue
    assert taken > count / 100


def test_no_tag_is_decoded():
    """A tagged regular expression of 64 KiB would take half a minute to compile, with the arm's poses waiting."""
    for payload in (*TAGGED, SHARED, b"\xc6" * 60_000):
        with pytest.raises(ProtocolViolation):
            decode_message(payload)


SOF = [encode(reply) for reply in REPLIES] + [
    encode_short(b"SUCCEED"),
    encode(b""),
    encode(REPLIES[0]) + encode(b"SOF"),
    PING + encode_sample(0, [[0.1] * 6, "Running"]) + PING + PING + encode_sample(0, []),
    PING[:5],
]
BARE = [*REPLIES, b" \r\n".join(REPLIES[:2]), b"[]"]


def decoded(chunks: Iterable[bytes]) -> tuple[list[bytes], bool]:
    """What a decoder hands over until it refuses, and whether it did. Any error but the right one is raised."""
    decoder, payloads = Decoder(), list[bytes]()
    for chunk in chunks:
        try:
            payloads += decoder.feed(chunk)
        except ProtocolViolation:
            return payloads, True
    return payloads, False


def test_any_stream_is_the_same_payloads_or_a_violation_wherever_it_is_cut(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(wire, "MAX_BYTES", 150)  # so that a message can be too long
    rng, taken, count = random.Random(1), 0, 0
    for stream in hostile([*SOF, *BARE, SOF[0] + BARE[0] + PING + SOF[1]], 2000):
        *coarser, finest = (decoded(chunks) for chunks in pieces(stream, rng))
        for payloads, refused in coarser:
            assert refused == finest[1], stream
            # a piece that holds a violation hands nothing over: what came before shows only in smaller pieces
            assert payloads == (finest[0][: len(payloads)] if refused else finest[0]), stream
        taken, count = taken + (not finest[1]), count + 1
    assert 200 < taken < count - 200, "neither all sound nor all broken"


@pytest.mark.parametrize("stream", [b"X", b"GET / HTTP/1.0\r\n", b"SOF\x02\x00\x00\x00\x01x", b"1", b'{"a":1}}'])
def test_bytes_that_belong_to_neither_framing_are_refused_at_once(stream: bytes):
    assert decoded([stream])[1]


ENDLESS: dict[str, tuple[bytes, bytes]] = {
    "a length of 4 GB": (b"SOF\x01\xff\xff\xff\xff", b""),
    "pings": (PING * 100_000 + b"SOF\x02", b""),
    "arrays in arrays": (b"[", b"[" * 3000),
    "a string": (b'{"a":"', b"\\" * 3000),
}


@pytest.mark.parametrize(("head", "more"), ENDLESS.values(), ids=ENDLESS.keys())
def test_declared_lengths_and_endless_messages_take_bounded_memory(
    head: bytes, more: bytes, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(wire, "MAX_BYTES", 100_000)
    tracemalloc.start()
    try:
        assert decoded([head, *[more] * 2000])[1]
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()


# ---------------------------------------------------------------- the two serial lines

Find = Callable[[bytes], object]
FINDERS: dict[str, tuple[Find, list[bytes]]] = {
    "ink station": (lambda received: station.find_reply(received, 5), LINES),
    "pump": (lambda received: pump.find_reply(received, START), FRAMES),
}


@pytest.mark.parametrize(("find", "valid"), FINDERS.values(), ids=FINDERS.keys())
def test_any_bytes_hold_one_reply_or_none_wherever_they_are_cut(find: Find, valid: list[bytes]):
    """As `SerialPort` asks: everything so far is shown after each piece, until something is made of it."""
    rng, replies = random.Random(31), 0
    for received in hostile(valid, 1000):
        firsts: list[object] = []
        for chunks in pieces(received, rng):
            shown = (find(b"".join(chunks[: end + 1])) for end in range(len(chunks)))
            firsts.append(next((reply for reply in shown if reply is not None), None))
        assert firsts[0] == firsts[1] == firsts[2], received
        replies += firsts[0] is not None
    assert replies > 50


@pytest.mark.parametrize("sound", [LINES[1], START], ids=["ink station", "pump"])
def test_one_bit_changed_never_says_something_else(sound: bytes):
    for bit in range(8 * len(sound)):
        damaged = bytearray(sound)
        damaged[bit // 8] ^= 1 << bit % 8
        assert pump.find_reply(bytes(damaged), START) is None
        assert station.find_reply(bytes(damaged), 5) in (None, "ok 0.730 1.250")


@pytest.mark.parametrize("text", ["dose 1.000", "okay", "err", "err 0 fine", "err x", "OK", ""])
def test_a_sound_line_that_is_no_reply_or_answers_another_request_is_passed_over(text: str):
    refusal = station.seal(7, "err 4 reservoir is empty")
    assert station.find_reply(station.seal(7, text) + station.seal(4, "ok 1.0") + refusal, 7) == refusal[4:-6].decode()


def test_confirmations_of_other_units_registers_and_values_are_passed_over():
    others = pump.write_register(2, 4, 1) + pump.write_register(1, 1, 1) + pump.write_register(1, 4, 0)
    others += refusal_of(2, 2) + refusal_of(1, 0)
    assert pump.find_reply(others, START) is None
    assert pump.find_reply(others + START, START) == 0
    assert pump.find_reply(REFUSAL + START, START) == 4


@pytest.mark.parametrize("word", ["nan", "inf", "1_0", "1e5", "٣", "-1", "", "1.", "12345678"])
def test_a_number_of_the_ink_station_is_a_plain_decimal(word: str):
    assert station.number_of("1.250") == 1.25
    with pytest.raises(ProtocolViolation):
        station.number_of(word)
