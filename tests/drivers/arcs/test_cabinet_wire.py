"""The loopback controller on the wire: JSON-RPC in two framings, and RTDE byte by byte."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import cbor2
import pytest

from brushloop.drivers.arcs.telemetry import encode_topic
from brushloop.drivers.arcs.wire import BareDecoder, FrameDecoder, encode, encode_short
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
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


@pytest.mark.parametrize("ident", ["xVoNsnVP-ERjD-powj", 0, None])
async def test_ids_are_echoed_as_given(ask: Ask, ident: object):
    (reply,) = await ask(request("getRobotNames", id=ident), 1)
    assert reply == {"id": ident, "jsonrpc": "2.0", "result": ["rob1"]}
    assert type(reply["id"]) is type(ident)


@pytest.mark.parametrize("params", [{"acc_rot": 2.0, "acc": 1.0}, [1.0, 2.0]])
async def test_params_are_taken_by_name_and_by_place(ask: Ask, params: object):
    (reply,) = await ask(request(STOP, id=1, params=params), 1)
    assert reply["result"] == 0


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (request("Nonsense", id="a"), -32601),
        (request(STOP, id="a"), -32602),
        (request(STOP, id="a", params={"acc": "fast", "acc_rot": 1.0}), -32602),
        (request("rob1.MotionControl.moveLine", id="a", params={"pose": [1], "a": 1, "v": 1}), -32602),
        (request("rob1.RobotAlgorithm.forwardKinematics", id="a", params=[[1e999] * 6]), -32602),
    ],
)
async def test_nonsense_gets_the_codes_of_json_rpc_and_its_id_back(ask: Ask, payload: bytes, code: int):
    (reply,) = await ask(payload, 1)
    assert (reply["id"], reply["error"]["code"]) == ("a", code)
    (again,) = await ask(request("getRobotNames", id=2), 1)
    assert again["result"] == ["rob1"]


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


EVERYTHING = ["timestamp", "R1_actual_q", "R1_robot_mode", "R1_safety_mode", "R1_actual_TCP_pose"]


class Client:
    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.decoder = FrameDecoder()

    async def greeting(self) -> bytes:
        return await self.reader.readuntil(b"}\n\n")

    async def some(self, count: int) -> list[Any]:
        """At least `count` pushes."""
        got: list[Any] = []
        while len(got) < count and (data := await self.reader.read(65536)):
            got += [cbor2.loads(p) for p in self.decoder.feed(data)]
        return got

    async def pushes(self, seconds: float) -> list[Any]:
        got: list[Any] = []
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while data := await self.reader.read(65536):
                    got += [cbor2.loads(p) for p in self.decoder.feed(data)]
        return got


@pytest.fixture
async def rtde(cabinet: ArcsServer) -> AsyncIterator[RtdeServer]:
    cabinet.cabinet.tcp_offset = [0.0, 0.0, 0.18, 0.0, 0.0, 0.0]
    server = RtdeServer(cabinet.cabinet)
    await server.start(HOST, 0)
    yield server
    await server.stop()


@pytest.fixture
async def client(rtde: RtdeServer) -> AsyncIterator[Client]:
    it = Client(*await asyncio.open_connection(HOST, rtde.port))
    yield it
    it.writer.close()
    await it.writer.wait_closed()


async def test_the_server_speaks_first(client: Client):
    hello = json.loads(await client.greeting())
    assert (hello["protocol"], hello["version"]) == ("rtde", 1)
    assert list(hello["output"]) == EVERYTHING
    assert hello["output"]["R1_actual_TCP_pose"] == 1021


async def test_the_makers_own_bytes_subscribe(client: Client):
    await client.greeting()
    client.writer.write(
        b"SOF\x00\x00\\\x82\x18d\xa5fchanel\x00ifrequency\xfaBH\x00\x00hsegments\x82kR1_actual_qrR1_actual_TCP_poseito_server\xf4gtrigger\x1aAAAA"
    )
    chanel, q, pose = (await client.some(5))[-1]
    assert (chanel, len(q)) == (0, 6)
    assert pose[:3] == pytest.approx([0.25, -0.23, 0.26])
    client.writer.write(
        b"SOF\x00\x009\x82\x18d\xa5fchanel\x00ifrequency\xfa\x00\x00\x00\x00hsegments\x80ito_server\xf4gtrigger\x00"
    )
    await client.pushes(0.05)
    assert await client.pushes(0.1) == []


@pytest.mark.parametrize("junk", [b"GET /", b"SOF\x02\x00\x01x", encode_short(b"\xff"), encode_short(b"[100, 5]")])
async def test_a_client_that_talks_nonsense_is_hung_up_on(client: Client, junk: bytes):
    await client.greeting()
    client.writer.write(junk)
    assert await client.reader.read() == b""


async def test_nothing_is_left_when_a_subscriber_goes(rtde: RtdeServer, client: Client):
    await client.greeting()
    client.writer.write(encode_topic(0, ["timestamp"], 500.0))
    assert await client.some(1)
    client.writer.close()
    while rtde.clients or [t for t in asyncio.all_tasks() if t.get_name() == "rtde push"]:
        await asyncio.sleep(0.005)


async def test_where_the_arm_rested_between_two_pushes_is_reported_where_time_runs_fast(
    client: Client, cabinet: ArcsServer
):
    await client.greeting()
    client.writer.write(encode_topic(0, ["R1_actual_TCP_pose", "timestamp"], 10.0))
    await client.pushes(0.15)
    motion, now_s = cabinet.cabinet.world.motion, cabinet.cabinet.now_s()
    for z_mm in (250.0, 260.0):  # over in a second of the arm's time, which is half of what lies between two pushes
        motion.add(brush_pose(250.0, -230.0, z_mm), 100.0, 1000.0, now_s)
    got = [(round(pose[2], 6), at_s) for _, pose, at_s in await client.pushes(0.3)]
    assert 0.25 in [z_m for z_m, _ in got]
    assert got == sorted(got, key=lambda sample: sample[1])
