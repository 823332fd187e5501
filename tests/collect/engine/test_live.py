"""The live view, seen by a viewer over its websocket, and not seen by anyone."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import struct
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
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
from brushloop.collect.start import collect
from brushloop.drivers.devices import Frame, Stamp
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import pose_message
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
    live.start()
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
async def test_a_viewer_sees_what_is_recorded_with_its_topic_schema_and_time(
    live: LiveView, outgoing: Outgoing
) -> None:
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
    # The kernel's own table: local address and port in hex, and 0A for listening.
    table = Path("/proc/self/net/tcp").read_text(encoding="ascii") + Path("/proc/self/net/tcp6").read_text("ascii")
    rows = [line.split() for line in table.splitlines()]
    [local] = [row[1] for row in rows if row[1].endswith(f":{live.port:04X}") and row[3] == "0A"]
    assert local == f"0100007F:{live.port:04X}"
    assert live.url == f"ws://127.0.0.1:{live.port}"


def test_a_port_that_is_taken_is_reported_in_one_line(live: LiveView) -> None:
    with pytest.raises(ConfigError, match=rf"--live: cannot listen on 127.0.0.1:{live.port}: .*in use") as caught:
        LiveView(port=live.port).start()
    assert caught.value.exit_code == 2


def test_without_the_extra_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"--live: needs foxglove-sdk: pip install 'brushloop\[live\]'") as caught:
        LiveView().start()
    assert caught.value.exit_code == 2


def test_a_run_with_a_viewer_shows_what_it_records_and_records_the_same(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = LiveView(port=0)
    request = CollectRequest(lab.folder / "rig.toml", lab.folder / "protocol.toml", lab.sessions, live=True)
    monkeypatch.setattr(start, "LiveView", lambda _port: live)
    seen: set[str] = set()

    async def look() -> None:
        while live.port == 0:
            await asyncio.sleep(0.01)
        names: dict[int, str] = {}
        async with watching(live.port) as viewer:
            while (message := await viewer.next()) is not None:
                if isinstance(message, dict):
                    for channel in message.get("channels", ()) if message["op"] == "advertise" else ():
                        names[channel["id"]] = channel["topic"]
                        await viewer.ask_for(channel["id"])
                elif message[0] == 1:
                    seen.add(names[struct.unpack_from("<I", message, 1)[0]])

    thread = threading.Thread(target=lambda: asyncio.run(look()))
    thread.start()
    assert collect(request).left_out == 0
    thread.join(timeout=PATIENCE_S)
    folder = lab.session
    assert verify_session(folder).sound
    recorded = set(McapFile(folder / f"{folder.name}.mcap").sound().stated)
    assert Topic.PREVIEW not in recorded
    assert {Topic.PREVIEW, Topic.TCP, Topic.WRENCH, Topic.STEP, Topic.STROKE} <= seen
    assert seen <= {*recorded, Topic.PREVIEW} - {Topic.STILL}
