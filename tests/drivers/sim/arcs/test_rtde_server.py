"""The loopback's RTDE port, byte by byte."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

import cbor2
import pytest

from brushloop.drivers.arcs.telemetry import PING, encode_topic
from brushloop.drivers.arcs.wire import FrameDecoder, encode, encode_short
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs.server import ArcsServer, RtdeServer
from brushloop.drivers.sim.rig import HOST

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
        async with asyncio.timeout(10.0):
            while len(got) < count and (data := await self.reader.read(65536)):
                got += [cbor2.loads(p) for p in self.decoder.feed(data)]
        return got

    async def pushes(self, seconds: float) -> list[Any]:
        got: list[Any] = []
        try:
            async with asyncio.timeout(seconds):
                while data := await self.reader.read(65536):
                    got += [cbor2.loads(p) for p in self.decoder.feed(data)]
        except TimeoutError:
            pass
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


async def test_a_pose_comes_no_more_often_than_the_driver_asks_for_it(client: Client, cabinet: ArcsServer):
    await client.greeting()
    began = asyncio.get_running_loop().time()
    client.writer.write(encode_topic(0, ["R1_actual_TCP_pose"], 100.0))
    got = await client.some(20)
    assert len(got) <= 2 + (asyncio.get_running_loop().time() - began) * 100.0
    assert all(len(pose) == 6 for _, pose in got)


async def test_the_pose_is_that_of_the_configured_tool(client: Client, cabinet: ArcsServer):
    cabinet.cabinet.tcp_offset = [0.0] * 6
    await client.greeting()
    client.writer.write(encode_topic(0, ["R1_actual_TCP_pose"], 100.0))
    _, pose = (await client.some(1))[-1]
    assert pose[:3] == pytest.approx([0.25, -0.23, 0.44])


async def test_everything_that_is_offered_can_be_had_with_enums_as_words(client: Client):
    await client.greeting()
    client.writer.write(encode_topic(3, EVERYTHING, 100.0))
    chanel, *values = (await client.some(1))[-1]
    sample = dict(zip(EVERYTHING, values, strict=True))
    assert chanel == 3
    assert (sample["R1_robot_mode"], sample["R1_safety_mode"]) == ("PowerOff", "Normal")


async def test_pings_are_skipped_and_two_channels_run_side_by_side(client: Client, rtde: RtdeServer):
    await client.greeting()
    client.writer.write(PING + encode_topic(0, ["timestamp"], 100.0) + PING + encode_topic(1, ["timestamp"], 20.0))
    got = await client.some(30)
    assert {chanel for chanel, _ in got} == {0, 1}
    assert rtde.pings == 2


@pytest.mark.parametrize("framed", [encode, encode_short])
async def test_long_and_short_frames_subscribe(client: Client, framed: Any):
    await client.greeting()
    topic = {"chanel": 0, "frequency": 100, "segments": ["timestamp"]}
    client.writer.write(framed(json.dumps([100, topic]).encode()))
    assert await client.some(1)


async def test_a_topic_with_an_unknown_name_pushes_nothing(client: Client):
    await client.greeting()
    client.writer.write(encode_topic(0, ["timestamp", "R9_nonsense"], 100.0))
    assert await client.pushes(0.1) == []


@pytest.mark.parametrize("junk", [b"GET /", b"SOF\x02\x00\x01x", encode_short(b"\xff"), encode_short(b"[100, 5]")])
async def test_a_client_that_talks_nonsense_is_hung_up_on(client: Client, junk: bytes):
    await client.greeting()
    client.writer.write(junk)
    async with asyncio.timeout(10.0):
        assert await client.reader.read() == b""


async def test_nothing_is_left_when_a_subscriber_goes(rtde: RtdeServer, client: Client):
    await client.greeting()
    client.writer.write(encode_topic(0, ["timestamp"], 500.0))
    assert await client.some(1)
    client.writer.close()
    async with asyncio.timeout(5.0):
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
