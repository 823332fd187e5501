"""The live view, seen by a viewer over its websocket, and not seen by anyone."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import socket
import struct
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap_protobuf.schema import build_file_descriptor_set

from brushloop.collect import start
from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.live import BACKLOG, HOST, LiveView
from brushloop.collect.errors import ConfigError
from brushloop.drivers.devices import Frame, Stamp
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import image_message, pose_message
from brushloop.sessions.records import Topic, Wrench
from brushloop.sessions.verify import verify_session
from tests.waiting import PATIENCE_S

if TYPE_CHECKING:
    from tests.rigs import Lab

pytest.importorskip("foxglove", reason="needs the extra [live]")
aiohttp = pytest.importorskip("aiohttp", reason="a viewer is made with it")


def pose(t_ns: int) -> Outgoing:
    return Outgoing(Topic.TCP, t_ns, t_ns, 0, pose_message(t_ns, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))


def wrench(t_ns: int) -> Outgoing:
    return Outgoing(Topic.WRENCH, t_ns, t_ns, 0, Wrench(fx_n=0.0, fy_n=0.0, fz_n=1.5, mx_nm=0.0, my_nm=0.0, mz_nm=0.0))


def frame(t_ns: int = 0, gray: int = 200) -> Frame:
    return Frame(Stamp(t_ns), t_ns, np.full((1536, 2048), gray, np.uint8))


@dataclass
class Viewer:
    """Speaks as much of Foxglove's protocol as it takes to look on."""

    socket: Any
    """An `aiohttp.ClientWebSocketResponse`."""

    async def next(self) -> dict[str, Any] | bytes | None:
        """A JSON message, or the bytes of a binary one; None once the server has hung up."""
        message = await self.socket.receive(PATIENCE_S)
        if message.type is aiohttp.WSMsgType.BINARY:
            return message.data
        if message.type is not aiohttp.WSMsgType.TEXT:
            return None
        told = json.loads(message.data)
        if told["op"] == "status" and told["message"].startswith("Unknown channel"):
            # foxglove-sdk advertises a channel a moment before it can be subscribed to.
            await self.ask_for(int(told["message"].split()[-1]))
        return told

    async def ask_for(self, channel: int) -> None:
        await self.socket.send_json({"op": "subscribe", "subscriptions": [{"id": channel, "channelId": channel}]})

    async def subscribe(self) -> dict[str, Any]:
        """To the next channel that is advertised; returns it."""
        while True:
            message = await self.next()
            if isinstance(message, dict) and message["op"] == "advertise":
                [channel] = message["channels"]
                await self.ask_for(channel["id"])
                return channel

    async def data(self) -> tuple[int, int, bytes]:
        """(channel, log time in ns, message) of the next message."""
        while True:
            message = await self.next()
            if isinstance(message, bytes) and message[0] == 1:
                number, log_ns = struct.unpack_from("<IQ", message, 1)
                return number, log_ns, message[13:]


@pytest.fixture
def live() -> Iterator[LiveView]:
    live = LiveView(port=0)
    yield live
    live.close()


@contextlib.asynccontextmanager
async def watching(port: int) -> AsyncIterator[Viewer]:
    async with (
        aiohttp.ClientSession() as client,
        client.ws_connect(f"http://{HOST}:{port}", protocols=["foxglove.sdk.v1"]) as socket,
    ):
        yield Viewer(socket)


@contextlib.asynccontextmanager
async def again_and_again(offer: Callable[[], None]) -> AsyncIterator[None]:
    """Offer as a robot would: a subscription takes effect at some time between two messages."""

    async def work() -> None:
        while True:
            offer()
            await asyncio.sleep(0.02)

    working = asyncio.create_task(work())
    yield
    working.cancel()


@pytest.mark.parametrize("outgoing", [pose(7), wrench(7)], ids=["protobuf", "json"])
async def test_a_viewer_sees_what_is_recorded_but_stills_with_its_topic_schema_and_time(
    live: LiveView, outgoing: Outgoing
) -> None:
    live.offer(Outgoing(Topic.STILL, 7, 7, 0, image_message(7, b"", "png")))
    async with watching(live.port) as viewer, again_and_again(lambda: live.offer(outgoing)):
        channel = await viewer.subscribe()
        number, log_ns, data = await viewer.data()
    assert (channel["topic"], number, log_ns) == (outgoing.topic, channel["id"], 7)
    if outgoing.topic is Topic.TCP:
        assert channel["schemaName"] == "foxglove.PoseInFrame"
        described = build_file_descriptor_set(PoseInFrame).SerializeToString()
        assert base64.b64decode(channel["schema"]) == described
        assert PoseInFrame.FromString(data) == outgoing.message
    else:
        assert channel["schemaName"] == "brushloop.Wrench"
        assert json.loads(channel["schema"]) == Wrench.model_json_schema()
        assert Wrench.model_validate_json(data) == outgoing.message


async def test_frames_are_shown_as_small_jpegs(live: LiveView) -> None:
    async with watching(live.port) as viewer, again_and_again(lambda: live.frame(frame(5))):
        channel = await viewer.subscribe()
        _, log_ns, data = await viewer.data()
    assert (channel["topic"], log_ns) == (Topic.PREVIEW, 5)
    shown = CompressedImage.FromString(data)
    image = cv2.imdecode(np.frombuffer(shown.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown.format == "jpeg"
    assert image is not None
    assert image.shape == (768, 1024)
    assert abs(float(image.mean()) - 200.0) < 2.0


async def test_nobody_waits_for_a_viewer_that_does_not_read(live: LiveView) -> None:
    live.offer(wrench(0))
    async with watching(live.port) as viewer:
        await viewer.subscribe()
        for t_ns in range(40 * BACKLOG):
            live.offer(wrench(t_ns))
        live.close()  # whoever waits for this viewer waits for ever


def test_it_listens_on_this_machine_only(live: LiveView) -> None:
    assert live.url == f"ws://127.0.0.1:{live.port}"
    with pytest.raises(ConnectionRefusedError):  # a port on every address would answer
        socket.create_connection(("127.0.0.2", live.port), PATIENCE_S)


def test_a_port_that_is_taken_is_reported_in_one_line(live: LiveView) -> None:
    with pytest.raises(ConfigError, match=rf"--live: cannot listen on 127.0.0.1:{live.port}: .*in use") as caught:
        LiveView(port=live.port)
    assert caught.value.exit_code == 2


def test_without_the_extra_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"--live: needs foxglove-sdk: pip install 'brushloop\[live\]'") as caught:
        LiveView(port=0)
    assert caught.value.exit_code == 2


def test_a_run_shows_what_it_records_and_what_the_camera_sees(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: set[str] = set()
    viewer = SimpleNamespace(
        url="",
        offer=lambda outgoing: shown.add(outgoing.topic),
        frame=lambda _: shown.add(Topic.PREVIEW),
        close=lambda: None,
    )
    monkeypatch.setattr(start, "LiveView", lambda _port: viewer)
    request = CollectRequest(lab.folder / "rig.toml", lab.folder / "protocol.toml", lab.sessions, live=True)
    assert start.collect(request).left_out == 0
    folder = lab.session
    assert verify_session(folder).sound
    assert shown == {Topic.PREVIEW, *McapFile(folder / f"{folder.name}.mcap").sound().stated}
