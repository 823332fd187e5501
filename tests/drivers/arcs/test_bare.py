import contextlib
import json
import tracemalloc
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.arcs.wire import MAX_DEPTH, BareDecoder, encode_bare_request
from brushloop.drivers.errors import ProtocolViolation

scalars = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text())
values = st.recursive(scalars, lambda v: st.lists(v, max_size=4) | st.dictionaries(st.text(), v, max_size=4))
documents = st.lists(st.dictionaries(st.text(), values, max_size=4), max_size=6)
gaps = st.sampled_from(["", "\n", " ", "\r\n\t "])


def test_a_request_is_the_one_that_the_maker_documents():
    assert encode_bare_request(1, "getRobotNames", None) == (
        b'{"jsonrpc":"2.0","method":"getRobotNames","params":[],"id":1}'
    )


def test_params_are_in_the_makers_order_whatever_the_callers():
    params = {"v": 0.25, "a": 1.2, "duration": 0.0, "blend_radius": 0.0, "pose": [0.4, -0.13, 0.2, 3.14, 0.0, 1.57]}
    request = json.loads(encode_bare_request(7, "rob1.MotionControl.moveLine", params))
    assert request["params"] == [[0.4, -0.13, 0.2, 3.14, 0.0, 1.57], 1.2, 0.25, 0.0, 0.0]


@pytest.mark.parametrize("params", [{}, {"acc": 1.0}, {"acc": 1.0, "acc_rot": 1.0, "quick": True}])
def test_params_that_the_method_does_not_have_are_not_sent(params: dict[str, object]):
    with pytest.raises(ValueError, match="stopLine"):
        encode_bare_request(1, "rob1.MotionControl.stopLine", params)


@settings(deadline=None)
@given(documents, gaps, st.booleans(), st.data())
def test_a_stream_decodes_to_the_same_documents_wherever_it_is_cut(
    sent: list[Any], gap: str, plain: bool, data: st.DataObject
):
    stream = gap.join(json.dumps(d, ensure_ascii=plain) for d in sent).encode("utf-8", "surrogatepass")
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    decoder = BareDecoder()
    edges = zip([0, *cuts], [*cuts, len(stream)], strict=True)
    assert [json.loads(d) for a, b in edges for d in decoder.feed(stream[a:b])] == sent


@settings(deadline=None)
@given(documents)
def test_a_stream_decodes_byte_by_byte(sent: list[Any]):
    decoder = BareDecoder()
    stream = "".join(json.dumps(d) for d in sent).encode()
    assert [json.loads(d) for byte in stream for d in decoder.feed(bytes([byte]))] == sent


PIECES = st.one_of(st.binary(max_size=20), st.sampled_from([b"{", b"}", b"[", b"]", b'"', b"\\", b'"a":', b"1,", b" "]))


@settings(deadline=None)
@given(st.lists(PIECES, max_size=30))
def test_garbage_gives_valid_json_or_a_protocol_violation_and_nothing_else(chunks: list[bytes]):
    decoder = BareDecoder()
    with contextlib.suppress(ProtocolViolation):
        for chunk in chunks:
            for document in decoder.feed(chunk):
                json.loads(document)


@pytest.mark.parametrize(
    "stream",
    [b"hello", b"GET / HTTP/1.0\r\n", b"SOF\x01", b"1", b'"a"', b"}", b"{]", b"{a}", b'{"a":1}}', b'{"a":"\xff"}'],
)
def test_what_is_no_json_is_refused_at_once(stream: bytes):
    with pytest.raises(ProtocolViolation):
        BareDecoder().feed(stream)


@pytest.mark.parametrize("opening", [b"[", b'{"a":'])
def test_deep_nesting_is_refused_before_the_parser_sees_it(opening: bytes):
    with pytest.raises(ProtocolViolation, match="deeper"):
        BareDecoder().feed(opening * 100_000)
    closing = b"]" if opening == b"[" else b"}"
    whole = opening * MAX_DEPTH + (b"1" if closing == b"}" else b"") + closing * MAX_DEPTH
    assert BareDecoder().feed(whole) == [whole]


def test_a_number_that_python_does_not_parse_is_refused():
    with pytest.raises(ProtocolViolation):
        BareDecoder().feed(b'{"a":' + b"9" * 10_000 + b"}")


@pytest.mark.parametrize("endless", [b'{"a":"' + b"x" * 4000, b"[" + b"1," * 2000, b"[" + b" " * 4000])
def test_a_document_that_never_ends_is_refused_with_little_memory(endless: bytes):
    decoder = BareDecoder(max_bytes=100_000)
    decoder.feed(endless)

    def feed_on() -> None:
        for _ in range(1000):
            decoder.feed(endless[6:])

    tracemalloc.start()
    try:
        with pytest.raises(ProtocolViolation, match="exceeds"):
            feed_on()
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_blanks_without_end_take_no_memory():
    decoder = BareDecoder(max_bytes=1000)
    for _ in range(1000):
        assert decoder.feed(b" \n" * 500) == []
    assert decoder.feed(b"{}") == [b"{}"]
