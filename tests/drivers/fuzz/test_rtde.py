"""What RTDE carries, CBOR or JSON, and its greeting: values or a `ProtocolViolation`, quickly and in bounded memory."""

from __future__ import annotations

import asyncio
import json
import random
import time
import tracemalloc
from typing import Any

import cbor2
import pytest
from hypothesis import given

from brushloop.drivers.arcs.telemetry import MAX_MESSAGE_BYTES, RtdeStream, decode_message, outputs_of
from brushloop.drivers.arcs.wire import encode_short
from brushloop.drivers.errors import DeviceError, ProtocolViolation
from tests.drivers.fuzz.inputs import EXAMPLES, LEAST_INPUTS, MANY, mutated, noise, truncated

VALUES: list[list[Any]] = [
    [0, [0.25, -0.23, 0.26, 3.14, 0.0, 1.57]],
    [0, "Running", True, None, 5, -(2**63), 1.5e300, {"a": [1, {"b": b"c"}]}],
    [100, {"chanel": 0, "frequency": 50.0, "segments": ["R1_actual_q"], "to_server": False, "trigger": 0}],
    [2**64 - 1, float("nan"), float("inf"), "é" * 20],
]
CBOR = [cbor2.dumps(values) for values in VALUES]
JSON = [json.dumps(values, default=str).encode() for values in VALUES]
TAGGED = [cbor2.dumps([0, cbor2.CBORTag(tag, body)]) for tag in range(300) for body in ("1", b"1", 1, [1, 2], {"a": 1})]
GREETINGS = [
    b'{"protocol":"rtde","version":1,"input":{"set_recipe":100},"output":{"R1_actual_TCP_pose":1021}}\n\n',
    b'{"protocol":"rtde","output":{}}\n\n',
]


def decode(payload: bytes) -> bool:
    """Whether it is a message; what it holds has the right types."""
    try:
        head, values = decode_message(payload, "rtde")
    except ProtocolViolation:
        return False
    assert type(head) is int
    assert type(values) is list
    return True


def test_any_payload_is_a_message_or_a_violation():
    inputs = taken = 0

    @EXAMPLES
    @given(MANY)
    def anything(payloads: list[bytes]) -> None:
        nonlocal inputs
        for payload in payloads:
            for begun in (payload, b"\x82\x00" + payload, b"[0," + payload):
                decode(begun)
                inputs += 1

    anything()
    valid = CBOR + JSON
    for payload in [*truncated(valid), *mutated(valid, 10_000, seed=4), *noise(1000, seed=5)]:
        taken += decode(payload)
        inputs += 1
    assert inputs >= LEAST_INPUTS
    assert taken > 1000


def test_any_greeting_gives_names_or_a_violation():
    inputs = taken = 0
    for greeting in [*truncated(GREETINGS), *mutated(GREETINGS, 10_000, seed=6), *noise(500, seed=7)]:
        inputs += 1
        try:
            outputs = outputs_of(greeting, "rtde")
        except ProtocolViolation:
            continue
        taken += 1
        assert all(type(name) is str and isinstance(ident, int) for name, ident in outputs.items())
    assert inputs >= LEAST_INPUTS
    assert taken > 200


async def test_any_stream_of_pushes_ends_in_values_or_in_a_device_error():
    """As telemetry reads it: several frames in one piece, or one in several."""
    rng = random.Random(8)
    frames = [encode_short(payload) for payload in (CBOR[0], JSON[0], CBOR[0] + b"\0")]
    streams = [frames[0] * 3, *mutated([frames[0], frames[1] + frames[0], *frames], 2000, seed=8)]
    taken = 0
    for data in streams:
        stream = RtdeStream("127.0.0.1", 1)
        stream._segments = ("R1_actual_TCP_pose",)
        stream._reader = asyncio.StreamReader()
        cut = rng.randint(0, len(data))
        stream._reader.feed_data(data[:cut])
        stream._reader.feed_data(data[cut:])
        stream._reader.feed_eof()
        try:
            values = await stream.newest()
        except DeviceError:
            continue
        assert len(values) == 1
        taken += 1
    assert taken > 50


def test_tagged_values_are_refused():
    assert not any(decode(payload) for payload in TAGGED)


PATTERN = "(?i)" + "".join(f"[\\x{i:02x}-\U0010ffff]" for i in range(256)) * 18
BIGNUM = b"\xc2\x59\xf0\x00" + b"\xff" * 0xF000
HOSTILE = {
    "regular expression": b"\x82\x00\xd8\x23" + cbor2.dumps(PATTERN),
    "decimal fraction": b"\x82\x00\xc4\x82\x00" + BIGNUM,
    "big float": b"\x82\x00\xc5\x82\x00" + BIGNUM,
    "rational": b"\x82\x00\xd8\x1e\x82" + BIGNUM[:0x7000] + BIGNUM[:0x7000],
    "shared cycle": b"\x82\x00\xd8\x1c\x82\x01\xd8\x1d\x00",
    "deep arrays": b"\x81" * 60_000,
    "deep maps": b"\xa1\x61a" * 20_000,
    "deep tags": b"\xc6" * 60_000,
    "deep JSON": b"[" * 65_000,
    "deep JSON objects": b'[{"a":' * 10_000,
    "long integer": b"[0," + b"9" * 60_000 + b"]",
    "many empty": b"\x9f" + b"\x80" * 65_000 + b"\xff",
} | {
    f"major {major}, length {length:#x}": b"\x82\x00"
    + bytes([major << 5 | 27])
    + length.to_bytes(8, "big")
    + b"\1" * 99
    for major in (2, 3, 4, 5)
    for length in (2**17, 2**28, 2**31, 2**32, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
}


@pytest.mark.parametrize("payload", HOSTILE.values(), ids=HOSTILE.keys())
def test_the_worst_payloads_take_little_time_and_memory(payload: bytes):
    assert len(payload) <= MAX_MESSAGE_BYTES
    began_s = time.process_time()
    decode(payload)
    assert time.process_time() - began_s < 2.0  # it was 19.5 s
    tracemalloc.start()
    try:
        decode(payload)
        assert tracemalloc.get_traced_memory()[1] < 8_000_000
    finally:
        tracemalloc.stop()
