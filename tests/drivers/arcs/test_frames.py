import contextlib
import json
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.arcs.wire import FACTORY_LOGIN_TOKEN, MAX_PAYLOAD_BYTES, FrameDecoder, encode, encode_request
from brushloop.drivers.errors import ProtocolViolation

payloads = st.lists(st.binary(max_size=300), max_size=8)


def test_the_first_frame_is_the_one_that_the_vendors_client_sends():
    request = encode_request("xVoNsnVP-ERjD-powj", "SystemInfo.getInterfaceVersionCode", None)
    assert encode(request) == bytes.fromhex("53 4f 46 01 00 00 00 59") + (
        b'{"id":"xVoNsnVP-ERjD-powj","jsonrpc":"2.0","method":"SystemInfo.getInterfaceVersionCode"}'
    )


def test_a_move_is_the_one_that_the_vendors_client_sends():
    pose = [0.4, -0.13, 0.2, 3.14, 0.0, 1.57]
    params = {"pose": pose, "a": 1.2, "v": 0.25, "blend_radius": 0.0, "duration": 0.0}
    assert encode_request("AHt2w5dt-hMOk-kk0M", "rob1.MotionControl.moveLine", params) == (
        b'{"id":"AHt2w5dt-hMOk-kk0M","jsonrpc":"2.0","method":"rob1.MotionControl.moveLine","params":'
        b'{"a":1.2,"blend_radius":0.0,"duration":0.0,"pose":[0.4,-0.13,0.2,3.14,0.0,1.57],"v":0.25}}'
    )


def test_the_login_frame_has_the_header_that_the_vendors_client_sends():
    login = f"__login__\naubo\n{FACTORY_LOGIN_TOKEN}\n0.24.0\n".encode()
    assert encode(login)[:8] == bytes.fromhex("53 4f 46 01 00 00 00 63")


def test_the_replies_that_the_vendors_client_accepts_are_decoded():
    version = b'{"id": "iebf8kxE-uFDQ-RIxB", "jsonrpc": "2.0", "result": 24000}'
    stream = bytes.fromhex("53 4f 46 01 00 00 00 3f") + version
    stream += bytes.fromhex("53 4f 46 01 00 00 00 07 53 55 43 43 45 45 44")
    first, second = FrameDecoder().feed(stream)
    assert json.loads(first)["result"] == 24000
    assert second == b"SUCCEED"


def test_a_frame_with_a_16_bit_length_is_decoded_too():
    assert FrameDecoder().feed(b"SOF\x00\x00\x05hello" + encode(b"world")) == [b"hello", b"world"]


@settings(deadline=None)
@given(payloads, st.data())
def test_a_stream_decodes_to_the_same_payloads_wherever_it_is_cut(sent: list[bytes], data: st.DataObject):
    stream = b"".join(encode(p) for p in sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    decoder = FrameDecoder()
    edges = zip([0, *cuts], [*cuts, len(stream)], strict=True)
    assert [p for a, b in edges for p in decoder.feed(stream[a:b])] == sent


@settings(deadline=None)
@given(payloads, st.integers(0, 100_000))
def test_a_cut_off_stream_gives_only_whole_payloads(sent: list[bytes], cut: int):
    stream = b"".join(encode(p) for p in sent)
    got = FrameDecoder().feed(stream[: min(cut, len(stream))])
    assert got == sent[: len(got)]


@settings(deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=40), st.binary(max_size=8).map(lambda b: b"SOF" + b)), max_size=10))
def test_garbage_gives_payloads_or_a_protocol_violation_and_nothing_else(chunks: list[bytes]):
    decoder = FrameDecoder()
    with contextlib.suppress(ProtocolViolation):
        for chunk in chunks:
            assert all(isinstance(payload, bytes) for payload in decoder.feed(chunk))


@pytest.mark.parametrize("start", [b"X", b"SX", b"GET / HTTP/1.0\r\n", b"SOF\x02\x00\x00\x00\x01x"])
def test_bytes_that_are_no_frame_are_refused_at_once(start: bytes):
    with pytest.raises(ProtocolViolation):
        FrameDecoder().feed(start)


def test_a_hostile_length_is_refused_before_anything_is_allocated():
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolViolation, match="exceeds"):
            FrameDecoder().feed(b"SOF\x01\xff\xff\xff\xff")
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_a_payload_that_no_peer_would_accept_is_not_sent():
    with pytest.raises(ValueError, match="exceeds"):
        encode(bytes(MAX_PAYLOAD_BYTES + 1))
