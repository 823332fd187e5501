"""The live view, seen by a viewer over its websocket, and not seen by anyone."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.reader import make_reader
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
from tests.rigs import Lab
from tests.waiting import PATIENCE_S

foxglove = pytest.importorskip("foxglove", reason="needs the extra [live]")
aiohttp = pytest.importorskip("aiohttp", reason="a viewer is made with it")


def wrench(t_ns: int) -> Outgoing:
    return Outgoing(Topic.WRENCH, t_ns, t_ns, 0, Wrench(fx_n=0.0, fy_n=0.0, fz_n=1.5, mx_nm=0.0, my_nm=0.0, mz_nm=0.0))


@pytest.fixture
def live() -> Iterator[LiveView]:
    live = LiveView(port=0)
    yield live
    live.close()


def test_a_viewer_sees_what_is_recorded_but_stills_and_small_jpegs_of_what_the_camera_sees(
    live: LiveView, tmp_path: Path
) -> None:
    """The SDK writes the same to a file as it sends to a viewer."""
    pose = Outgoing(Topic.TCP, 7, 7, 0, pose_message(7, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))
    with foxglove.open_mcap(tmp_path / "seen.mcap", context=live._context):
        live.offer(Outgoing(Topic.STILL, 7, 7, 0, image_message(7, b"", "png")))
        live.offer(pose)
        live.offer(wrench(7))
        live.frame(Frame(Stamp(5), 5, np.full((1536, 2048), 200, np.uint8)))
    with (tmp_path / "seen.mcap").open("rb") as file:
        seen = {channel.topic: (schema, message) for schema, channel, message in make_reader(file).iter_messages()}
    assert seen.keys() == {Topic.TCP, Topic.WRENCH, Topic.PREVIEW}

    schema, message = seen[Topic.TCP]
    assert (schema.name, message.log_time) == ("foxglove.PoseInFrame", 7)
    assert schema.data == build_file_descriptor_set(PoseInFrame).SerializeToString()
    assert PoseInFrame.FromString(message.data) == pose.message
    schema, message = seen[Topic.WRENCH]
    assert (schema.name, message.log_time) == ("brushloop.Wrench", 7)
    assert json.loads(schema.data) == Wrench.model_json_schema()
    assert Wrench.model_validate_json(message.data) == wrench(7).message
    _, message = seen[Topic.PREVIEW]
    shown = CompressedImage.FromString(message.data)
    image = cv2.imdecode(np.frombuffer(shown.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (message.log_time, shown.format) == (5, "jpeg")
    assert image is not None
    assert image.shape == (768, 1024)
    assert abs(float(image.mean()) - 200.0) < 2.0


async def test_nobody_waits_for_a_viewer_that_looks_once_and_then_reads_no_more(live: LiveView) -> None:
    async def offered_again_and_again() -> None:
        """As by a robot: a subscription takes effect at some time between two messages."""
        while True:
            live.offer(wrench(7))
            await asyncio.sleep(0.02)

    channels: list[int] = []
    async with (
        aiohttp.ClientSession() as client,
        client.ws_connect(f"http://{HOST}:{live.port}", protocols=["foxglove.sdk.v1"]) as viewer,
    ):
        async with alongside(offered_again_and_again(), "offers"):
            while (message := await viewer.receive(PATIENCE_S)).type is not aiohttp.WSMsgType.BINARY:
                channels += [channel["id"] for channel in json.loads(message.data).get("channels", [])]
                # Again at every word: foxglove-sdk advertises a channel a moment before it can be subscribed to.
                subscriptions = [{"id": number, "channelId": number} for number in channels]
                await viewer.send_json({"op": "subscribe", "subscriptions": subscriptions})
        assert struct.unpack_from("<Q", message.data, 5) == (7,), "the log time"
        for t_ns in range(40 * BACKLOG):
            live.offer(wrench(t_ns))
        live.close()  # whoever waits for this viewer waits for ever


def test_it_listens_on_this_machine_only_and_a_port_that_is_taken_is_reported_in_one_line(live: LiveView) -> None:
    assert live.url == f"ws://127.0.0.1:{live.port}"
    with pytest.raises(ConnectionRefusedError):  # a port on every address would answer
        socket.create_connection(("127.0.0.2", live.port), PATIENCE_S)
    with pytest.raises(ConfigError, match=rf"--live: cannot listen on 127.0.0.1:{live.port}: .*in use"):
        LiveView(port=live.port)


def test_without_the_extra_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match=r"--live: needs foxglove-sdk: pip install 'brushloop\[live\]'"):
        LiveView(port=0)


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
