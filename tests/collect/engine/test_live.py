"""The live view, seen by a viewer over its websocket, and not seen by anyone."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap_protobuf.schema import build_file_descriptor_set

from brushloop.collect.engine.live import BACKLOG, HOST, LiveView
from brushloop.collect.errors import ConfigError
from brushloop.collect.start import CollectRequest, collect
from brushloop.drivers.devices import Frame, Stamp
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import pose_message
from brushloop.sessions.records import Topic, Wrench
from brushloop.sessions.verify import verify_session
from tests.command import brushloop
from tests.waiting import PATIENCE_S

if TYPE_CHECKING:
    from tests.rigs import Lab

pytest.importorskip("foxglove", reason="needs the extra [live]")


def pose(t_ns: int) -> Outgoing:
    return Outgoing(Topic.TCP, t_ns, t_ns, 0, pose_message(t_ns, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))


def wrench(t_ns: int) -> Outgoing:
    return Outgoing(Topic.WRENCH, t_ns, t_ns, 0, Wrench(fx_n=0.0, fy_n=0.0, fz_n=1.5, mx_nm=0.0, my_nm=0.0, mz_nm=0.0))


def frame(t_ns: int = 0, gray: int = 200) -> Frame:
    return Frame(Stamp(t_ns), t_ns, np.full((1536, 2048), gray, np.uint8))


class HungUp(Exception):
    """The server has closed the connection."""


@dataclass
class Viewer:
    """Speaks as much websocket (RFC 6455) and of Foxglove's protocol as it takes to look on."""

    wire: socket.socket
    rest: bytes = b""

    @classmethod
    def connect(cls, port: int) -> Viewer:
        viewer = cls(socket.create_connection((HOST, port), timeout=PATIENCE_S))
        key = base64.b64encode(os.urandom(16)).decode()
        head = f"GET / HTTP/1.1\r\nHost: {HOST}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        head += f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
        viewer.wire.sendall(f"{head}Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode())
        while b"\r\n\r\n" not in viewer.rest:
            viewer.rest += viewer.wire.recv(65536)
        answer, viewer.rest = viewer.rest.split(b"\r\n\r\n", 1)
        assert answer.startswith(b"HTTP/1.1 101")
        return viewer

    def _take(self, count: int) -> bytes:
        while len(self.rest) < count:
            data = self.wire.recv(65536)
            if not data:
                raise HungUp
            self.rest += data
        taken, self.rest = self.rest[:count], self.rest[count:]
        return taken

    def next(self) -> dict[str, Any] | bytes:
        """A JSON message, or the bytes of a binary one."""
        kind, length = self._take(2)
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._take(8))
        payload = self._take(length)
        if kind & 0x0F == 8:
            raise HungUp
        if kind & 0x0F == 2:
            return payload
        message = json.loads(payload)
        if message["op"] == "status" and message["message"].startswith("Unknown channel"):
            # foxglove-sdk advertises a channel a moment before it can be subscribed to.
            self.ask_for(int(message["message"].split()[-1]))
        return message

    def until(self, op: str) -> dict[str, Any]:
        while True:
            message = self.next()
            if isinstance(message, dict) and message["op"] == op:
                return message

    def send(self, message: dict[str, Any]) -> None:
        text, mask = json.dumps(message).encode(), os.urandom(4)
        masked = bytes(byte ^ mask[k % 4] for k, byte in enumerate(text))
        self.wire.sendall(struct.pack(">BBH", 0x81, 0x80 | 126, len(text)) + mask + masked)

    def subscribe(self) -> dict[str, Any]:
        """To the next channel that is advertised; returns it."""
        [channel] = self.until("advertise")["channels"]
        self.ask_for(channel["id"])
        return channel

    def ask_for(self, channel: int) -> None:
        self.send({"op": "subscribe", "subscriptions": [{"id": channel, "channelId": channel}]})

    def data(self) -> tuple[int, int, bytes]:
        """(channel, log time in ns, message) of the next message."""
        while True:
            message = self.next()
            if isinstance(message, bytes) and message[0] == 1:
                number, log_ns = struct.unpack_from("<IQ", message, 1)
                return number, log_ns, message[13:]


@pytest.fixture
def live() -> Iterator[LiveView]:
    live = LiveView(port=0)
    live.start()
    yield live
    live.close()


@pytest.fixture
def viewer(live: LiveView) -> Iterator[Viewer]:
    viewer = Viewer.connect(live.port)
    yield viewer
    with contextlib.suppress(OSError):  # the server may be gone already
        viewer.wire.sendall(bytes([0x88, 0x80, 0, 0, 0, 0]))  # good-bye
    viewer.wire.close()


@contextlib.contextmanager
def again_and_again(offer: Callable[[], None]) -> Iterator[None]:
    """Offer as a robot would: a subscription takes effect at some time between two messages."""
    over = threading.Event()

    def work() -> None:
        while not over.wait(0.02):
            offer()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize("outgoing", [pose(7), wrench(7)], ids=["protobuf", "json"])
def test_a_viewer_sees_what_is_recorded_with_its_topic_schema_and_time(
    live: LiveView, viewer: Viewer, outgoing: Outgoing
) -> None:
    with again_and_again(lambda: live.offer(outgoing)):
        channel = viewer.subscribe()
        number, log_ns, data = viewer.data()
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


def test_frames_are_shown_as_small_jpegs(live: LiveView, viewer: Viewer) -> None:
    with again_and_again(lambda: live.frame(frame(5))):
        channel = viewer.subscribe()
        _, log_ns, data = viewer.data()
    assert (channel["topic"], log_ns) == (Topic.PREVIEW, 5)
    shown = CompressedImage.FromString(data)
    image = cv2.imdecode(np.frombuffer(shown.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert shown.format == "jpeg"
    assert image.shape == (768, 1024)
    assert abs(float(image.mean()) - 200.0) < 2.0


def test_nobody_waits_for_a_viewer_that_does_not_read(live: LiveView, viewer: Viewer) -> None:
    live.offer(wrench(0))
    viewer.subscribe()
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


def test_a_run_with_a_viewer_shows_what_it_records_and_records_the_same(lab: Lab) -> None:
    live = LiveView(port=0)
    request = CollectRequest(lab.folder / "rig.toml", lab.folder / "protocol.toml", lab.sessions, live=live)
    seen: set[str] = set()

    def look() -> None:
        while live.port == 0:
            time.sleep(0.01)
        viewer, names = Viewer.connect(live.port), {}
        with contextlib.suppress(HungUp):
            while True:
                message = viewer.next()
                if isinstance(message, dict):
                    for channel in message.get("channels", ()) if message["op"] == "advertise" else ():
                        names[channel["id"]] = channel["topic"]
                        viewer.ask_for(channel["id"])
                elif message[0] == 1:
                    seen.add(names[struct.unpack_from("<I", message, 1)[0]])
        viewer.wire.close()

    thread = threading.Thread(target=look)
    thread.start()
    assert collect(request).left_out == 0
    thread.join(timeout=PATIENCE_S)
    folder = lab.session
    assert verify_session(folder).sound
    recorded = set(McapFile(folder / f"{folder.name}.mcap").sound().stated)
    assert Topic.PREVIEW not in recorded
    assert {Topic.PREVIEW, Topic.TCP, Topic.WRENCH, Topic.STEP, Topic.STROKE} <= seen
    assert seen <= {*recorded, Topic.PREVIEW} - {Topic.STILL}


def test_the_command_refuses_a_port_that_is_taken_before_anything_is_connected(lab: Lab, live: LiveView) -> None:
    command = ["collect", "--no-tui", "--live", "--live-port", str(live.port), "--out", lab.sessions]
    done = brushloop(*command, "--config", lab.folder / "rig.toml", "--protocol", lab.folder / "protocol.toml")
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(f"brushloop: --live: cannot listen on 127.0.0.1:{live.port}")
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"
    assert not lab.sessions.exists()
