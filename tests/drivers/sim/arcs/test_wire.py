"""One port, two framings, params with and without names, ids of any kind."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest

from brushloop.drivers.arcs.wire import BareDecoder, FrameDecoder, encode
from brushloop.drivers.sim.arcs.server import ArcsServer
from brushloop.drivers.sim.rig import HOST

Ask = Callable[[bytes, int], Awaitable[list[Any]]]
STOP = "rob1.MotionControl.stopLine"


@pytest.fixture(params=["sof", "short sof", "bare"])
async def ask(request: pytest.FixtureRequest, cabinet: ArcsServer) -> AsyncIterator[Ask]:
    """Send the bytes of requests in one framing, and hand back this many replies."""
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    decoder = BareDecoder() if request.param == "bare" else FrameDecoder()

    async def exchange(payload: bytes, count: int = 1) -> list[Any]:
        match request.param:
            case "sof":
                writer.write(encode(payload))
            case "short sof":
                writer.write(b"SOF\x00" + len(payload).to_bytes(2, "big") + payload)
            case _:
                writer.write(payload)
        replies: list[Any] = []
        async with asyncio.timeout(2.0):
            while len(replies) < count:
                data = await reader.read(4096)
                assert data, "hung up"
                replies += [json.loads(r) for r in decoder.feed(data)]
        return replies

    yield exchange
    writer.close()
    await writer.wait_closed()


def request(method: str, **body: Any) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "method": method, **body}).encode()


@pytest.mark.parametrize("ident", ["xVoNsnVP-ERjD-powj", "", 1, 0, 2**40, None])
async def test_ids_are_echoed_as_given(ask: Ask, ident: object):
    (reply,) = await ask(request("getRobotNames", id=ident), 1)
    assert reply == {"id": ident, "jsonrpc": "2.0", "result": ["rob1"]}
    assert type(reply["id"]) is type(ident)


@pytest.mark.parametrize("body", [{}, {"params": []}, {"params": {}}, {"params": None}])
async def test_params_may_be_missing(ask: Ask, body: dict[str, Any]):
    (reply,) = await ask(request("getRobotNames", id=1, **body), 1)
    assert reply["result"] == ["rob1"]


@pytest.mark.parametrize("params", [{"acc_rot": 2.0, "acc": 1.0}, [1.0, 2.0]])
async def test_params_are_taken_by_name_and_by_place(ask: Ask, params: object):
    (reply,) = await ask(request(STOP, id=1, params=params), 1)
    assert reply["result"] == 0


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (request("Nonsense", id="a"), -32601),
        (request("rob1.Nonsense", id="a", params=[1]), -32601),
        (request(STOP, id="a"), -32602),
        (request(STOP, id="a", params=[1.0]), -32602),
        (request(STOP, id="a", params=[1.0, 2.0, 3.0]), -32602),
        (request(STOP, id="a", params={"acc": 1.0}), -32602),
        (request(STOP, id="a", params={"acc": "fast", "acc_rot": 1.0}), -32602),
        (request(STOP, id="a", params=5), -32602),
        (request("rob1.MotionControl.moveLine", id="a", params={"pose": [1], "a": 1, "v": 1}), -32602),
        (request("rob1.RobotAlgorithm.forwardKinematics", id="a", params=[[1e999] * 6]), -32602),
    ],
)
async def test_nonsense_gets_the_codes_of_json_rpc_and_its_id_back(ask: Ask, payload: bytes, code: int):
    (reply,) = await ask(payload, 1)
    assert (reply["id"], reply["error"]["code"]) == ("a", code)
    (again,) = await ask(request("getRobotNames", id=2), 1)
    assert again["result"] == ["rob1"]


async def test_what_is_no_json_gets_a_parse_error(ask: Ask):
    (reply,) = await ask(b"{garbage}", 1)
    assert (reply["id"], reply["error"]["code"]) == (None, -32700)


async def bare(cabinet: ArcsServer, *pieces: bytes, count: int) -> list[Any]:
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    for piece in pieces:
        writer.write(piece)
        await asyncio.sleep(0.002)
    decoder, replies = BareDecoder(), []
    while len(replies) < count and (data := await reader.read(4096)):
        replies += [json.loads(r) for r in decoder.feed(data)]
    writer.close()
    await writer.wait_closed()
    return replies


async def test_bare_requests_may_come_together_or_in_pieces(cabinet: ArcsServer):
    first, second = request("getRobotNames", id=1), request("RuntimeMachine.getRuntimeState", id=2)
    whole = first + b"\n" + second
    for pieces in ([whole], [whole[:1], whole[1:30], whole[30:31], whole[31:]]):
        assert [r["id"] for r in await bare(cabinet, *pieces, count=2)] == [1, 2]


async def test_bare_replies_end_with_their_last_bracket(cabinet: ArcsServer):
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    writer.write(request("getRobotNames", id=1))
    assert await reader.read(4096) == b'{"id":1,"jsonrpc":"2.0","result":["rob1"]}'
    writer.close()
    await writer.wait_closed()


async def test_a_bare_client_that_sends_no_json_gets_an_error_and_is_disconnected(cabinet: ArcsServer):
    (reply,) = await bare(cabinet, b"{]", count=2)
    assert reply["error"]["code"] == -32700


async def test_the_header_of_a_reply_comes_in_one_piece(cabinet: ArcsServer):
    reader, writer = await asyncio.open_connection(HOST, cabinet.port)
    for _ in range(50):
        writer.write(encode(request("rob1.RobotState.getTcpPose", id="a")))
        assert len(await reader.read(65536)) > 8
    writer.close()
    await writer.wait_closed()


async def test_a_framing_holds_for_its_own_connection_only(cabinet: ArcsServer):
    sof_reader, sof_writer = await asyncio.open_connection(HOST, cabinet.port)
    assert await bare(cabinet, request("getRobotNames", id=1), count=1)
    sof_writer.write(encode(request("getRobotNames", id="a")))
    assert (await sof_reader.read(4096)).startswith(b"SOF\x01")
    sof_writer.close()
    await sof_writer.wait_closed()
