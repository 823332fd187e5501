"""The live view, seen by a viewer over its websocket, and not seen by anyone."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import socket
import struct
import sys
from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import dataclass, field
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
from brushloop.drivers.host import alongside
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


def wrench(t_ns: int) -> Outgoing:
    return Outgoing(Topic.WRENCH, t_ns, t_ns, 0, Wrench(fx_n=0.0, fy_n=0.0, fz_n=1.5, mx_nm=0.0, my_nm=0.0, mz_nm=0.0))


@pytest.fixture
def live() -> Iterator[LiveView]:
    live = LiveView(port=0)
    yield live
    live.close()


@dataclass
class Viewer:
    """Speaks as much of Foxglove's protocol as it takes to look on."""

    socket: Any
    """An `aiohttp.ClientWebSocketResponse`."""
    channels: dict[int, dict[str, Any]] = field(default_factory=dict)
    """What was advertised, and is subscribed to."""

    async def next(self) -> tuple[dict[str, Any], int, bytes] | None:
        """(channel, log time in ns, message) that comes next; None where it is word of another kind."""
        message = await self.socket.receive(PATIENCE_S)
        if message.type is aiohttp.WSMsgType.BINARY:
            number, log_ns = struct.unpack_from("<IQ", message.data, 1)
            return self.channels[number], log_ns, message.data[13:]
        answer = json.loads(message.data)
        if answer["op"] == "advertise":
            self.channels |= {channel["id"]: channel for channel in answer["channels"]}
            await self._subscribe(channel["id"] for channel in answer["channels"])
        if answer["op"] == "status" and answer["message"].startswith("Unknown channel"):
            # foxglove-sdk advertises a channel a moment before it can be subscribed to.
            await self._subscribe([int(answer["message"].split()[-1])])
        return None

    async def _subscribe(self, numbers: Iterable[int]) -> None:
        subscriptions = [{"id": number, "channelId": number} for number in numbers]
        await self.socket.send_json({"op": "subscribe", "subscriptions": subscriptions})


@contextlib.asynccontextmanager
async def watching(port: int) -> AsyncIterator[Viewer]:
    async with (
        aiohttp.ClientSession() as client,
        client.ws_connect(f"http://{HOST}:{port}", protocols=["foxglove.sdk.v1"]) as socket,
    ):
        yield Viewer(socket)


async def test_a_viewer_sees_what_is_recorded_but_stills_and_small_jpegs_of_what_the_camera_sees(
    live: LiveView,
) -> None:
    pose = Outgoing(Topic.TCP, 7, 7, 0, pose_message(7, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))
    frame = Frame(Stamp(5), 5, np.full((1536, 2048), 200, np.uint8))

    async def offered_again_and_again() -> None:
        """As by a robot: a subscription takes effect at some time between two messages."""
        while True:
            live.offer(Outgoing(Topic.STILL, 7, 7, 0, image_message(7, b"", "png")))
            live.offer(pose)
            live.offer(wrench(7))
            live.frame(frame)
            await asyncio.sleep(0.02)

    seen: dict[str, tuple[dict[str, Any], int, bytes]] = {}
    async with watching(live.port) as viewer, alongside(offered_again_and_again(), "offers"):
        while len(seen) < 3:
            if (message := await viewer.next()) is not None:
                seen[message[0]["topic"]] = message
        assert {channel["topic"] for channel in viewer.channels.values()} == {Topic.TCP, Topic.WRENCH, Topic.PREVIEW}

    channel, log_ns, data = seen[Topic.TCP]
    assert (channel["schemaName"], log_ns) == ("foxglove.PoseInFrame", 7)
    assert base64.b64decode(channel["schema"]) == build_file_descriptor_set(PoseInFrame).SerializeToString()
    assert PoseInFrame.FromString(data) == pose.message
    channel, log_ns, data = seen[Topic.WRENCH]
    assert (channel["schemaName"], log_ns) == ("brushloop.Wrench", 7)
    assert json.loads(channel["schema"]) == Wrench.model_json_schema()
    assert Wrench.model_validate_json(data) == wrench(7).message
    _, log_ns, data = seen[Topic.PREVIEW]
    shown = CompressedImage.FromString(data)
    image = cv2.imdecode(np.frombuffer(shown.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (log_ns, shown.format) == (5, "jpeg")
    assert image is not None
    assert image.shape == (768, 1024)
    assert abs(float(image.mean()) - 200.0) < 2.0


async def test_nobody_waits_for_a_viewer_that_does_not_read(live: LiveView) -> None:
    live.offer(wrench(0))
    async with watching(live.port) as viewer:
        while not viewer.channels:
            await viewer.next()
        for t_ns in range(40 * BACKLOG):
            live.offer(wrench(t_ns))
        live.close()  # whoever waits for this viewer waits for ever


def test_it_listens_on_this_machine_only_and_a_port_that_is_taken_is_reported_in_one_line(live: LiveView) -> None:
    assert live.url == f"ws://127.0.0.1:{live.port}"
    with pytest.raises(ConnectionRefusedError):  # a port on every address would answer
        socket.create_connection(("127.0.0.2", live.port), PATIENCE_S)
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
    assert start.collect(request).given_up == 0
    folder = lab.session
    assert verify_session(folder).sound
    assert shown == {Topic.PREVIEW, *McapFile(folder / f"{folder.name}.mcap").sound().stated}
