"""The two framings of ARCS, fed with anything in any pieces: payloads or a `ProtocolViolation`, in bounded memory."""

from __future__ import annotations

import json
import random
import tracemalloc
from collections.abc import Callable

import pytest
from hypothesis import given

from brushloop.drivers.arcs.telemetry import MAX_MESSAGE_BYTES, PING, encode_sample
from brushloop.drivers.arcs.wire import BareDecoder, FrameDecoder, encode, encode_short
from brushloop.drivers.errors import ProtocolViolation
from tests.drivers.fuzz.inputs import (
    EXAMPLES,
    LEAST_INPUTS,
    MANY,
    Decode,
    decoded,
    holds_for_every_cut,
    mutated,
    noise,
    truncated,
)

REPLIES = [
    b'{"id": "iebf8kxE-uFDQ-RIxB", "jsonrpc": "2.0", "result": 24000}',
    b'{"id":7,"jsonrpc":"2.0","result":[0.25,-0.23,0.26,3.14,0.0,1.57]}',
    b'{"id":1,"jsonrpc":"2.0","error":{"code":-32601,"message":"method not found: \\"a\\\\b\\u00e9\\"}]"}}',
    json.dumps(
        {"id": 2, "result": [{"code": 30047, "args": ["é[{", "\\"], "timestamp": 1}]}, ensure_ascii=False
    ).encode(),
    b"[]",
]
SOF = [encode(reply) for reply in REPLIES] + [
    encode_short(b"SUCCEED"),
    encode(b""),
    encode(REPLIES[0]) + encode(b"SOF"),
]
PUSHES = [PING + encode_sample(0, [[0.1] * 6, "Running"]) + PING + PING + encode_sample(0, []), PING[:5]]
BARE = [*REPLIES, REPLIES[0] + REPLIES[1], b" \r\n".join(REPLIES)]
SMALL_BYTES = 150
"""Limit of the decoders under test, so that a message can be too long."""

STREAMS: list[tuple[Callable[[], Decode], list[bytes]]] = [
    (lambda: FrameDecoder(max_bytes=SMALL_BYTES).feed, SOF),
    (lambda: FrameDecoder(skip=PING, max_bytes=SMALL_BYTES).feed, SOF + PUSHES),
    (lambda: BareDecoder(max_bytes=SMALL_BYTES).feed, BARE),
]


@pytest.mark.parametrize(("new", "valid"), STREAMS, ids=["SOF", "SOF with pings", "bare"])
def test_any_stream_in_any_pieces_is_payloads_or_a_violation(new: Callable[[], Decode], valid: list[bytes]):
    rng = random.Random(1)
    inputs = taken = 0

    @EXAMPLES
    @given(MANY)
    def anything(streams: list[bytes]) -> None:
        nonlocal inputs
        for stream in streams:
            for begun in (stream, valid[0][:8] + stream):
                holds_for_every_cut(new, begun, rng)
                inputs += 1

    anything()
    for stream in [*truncated(valid), *mutated(valid, 5500, seed=1), *noise(500, seed=2)]:
        taken += holds_for_every_cut(new, stream, rng)
        inputs += 1
    assert inputs >= LEAST_INPUTS
    assert 1000 < taken < inputs - 1000, "neither all sound nor all broken"


@pytest.mark.parametrize(("new", "valid"), STREAMS, ids=["SOF", "SOF with pings", "bare"])
def test_a_violation_is_final(new: Callable[[], Decode], valid: list[bytes]):
    for stream in mutated(valid, 500, seed=3):
        feed = new()
        if decoded(feed, [stream])[1]:
            for more in (b"", valid[0]):
                with pytest.raises(ProtocolViolation):
                    feed(more)


ENDLESS: dict[str, tuple[Callable[[], Decode], bytes, bytes]] = {
    "a length of 4 GB": (lambda: FrameDecoder().feed, b"SOF\x01\xff\xff\xff\xff", b""),
    "a length above the limit": (
        lambda: FrameDecoder(max_bytes=MAX_MESSAGE_BYTES).feed,
        b"SOF\x01\x00\x01\x00\x01",
        b"",
    ),
    "pings": (lambda: FrameDecoder(skip=PING).feed, PING * 100_000 + b"SOF\x02", b""),
    "arrays in arrays": (lambda: BareDecoder().feed, b"[", b"["),
    "a string": (lambda: BareDecoder(max_bytes=100_000).feed, b'{"a":"', b"\\" * 300),
    "a list": (lambda: BareDecoder(max_bytes=100_000).feed, b"[1", b",[]" * 100),
}


@pytest.mark.parametrize(("new", "head", "more"), ENDLESS.values(), ids=ENDLESS.keys())
def test_declared_lengths_and_endless_messages_take_bounded_memory(new: Callable[[], Decode], head: bytes, more: bytes):
    feed = new()
    tracemalloc.start()
    try:
        _, refused = decoded(feed, [head, *[more] * 2000])
        assert refused
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()
