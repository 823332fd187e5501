"""The loopback camera: an MJPEG stream over HTTP, one new image per period to every client that keeps up."""

from __future__ import annotations

import asyncio
import random
import time
from collections import deque
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.camera.source import LOOPBACK_SERVER
from brushloop.drivers.devices import Pose
from brushloop.drivers.server import LoopbackServer
from brushloop.drivers.sim.config import View
from brushloop.drivers.sim.faults import Device, FaultBoard
from brushloop.drivers.sim.scene import NOISE_FIELDS, Scene, Wall

NOISE_LEVELS = 6
"""Number of gray levels of a covered sensor, which is not quite black."""


def black(jpeg: bytes) -> bytes:
    """A picture of the same size as taken with the lens cap on, other than the one before."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return cv2.imencode(".jpg", np.random.default_rng().integers(0, NOISE_LEVELS, image.shape, np.uint8))[1].tobytes()


def renumbered(jpeg: bytes, number: int) -> bytes:
    """The same picture with other bytes: a JPEG comment with a number is inserted after the two start bytes."""
    text = b"%d" % number
    comment = b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text
    return jpeg[:2] + comment + jpeg[2:]


def torn(jpeg: bytes) -> bytes:
    """The first half with a valid end mark: the rest never arrived."""
    return jpeg[: len(jpeg) // 2] + b"\xff\xd9"


SPOILED: dict[str, Callable[[bytes], bytes]] = {"black": black, "torn": torn}
"""Faults of a single picture: JPEG in, JPEG out."""
BOUNDARY = "brushloop"
NEXT_S = 1e-6
"""Time between two pictures that are due at once, because timers with the same time run in any order."""
BACKLOG = 64
"""Images that a stalled stream keeps, as the buffers of a real one do."""


class _Line:
    """One client's connection with the view's delay; no picture overtakes another."""

    def __init__(self, view: View, writer: asyncio.StreamWriter) -> None:
        self._view = view
        self._writer = writer
        self._loop = asyncio.get_running_loop()
        self._last_s = self._exposed_s = self._loop.time()
        self._random = random.Random(0)

    def exposed(self) -> None:
        """Note that the next picture is exposed now: its delay counts from here and includes the time to draw it."""
        self._exposed_s = self._loop.time()

    async def send(self, data: bytes) -> None:
        """Send now, or as soon as it is due."""
        view = self._view
        late_s = view.delay_s + view.delay_jitter_s * self._random.random()
        if late_s <= 0.0:
            self._writer.write(data)
            await self._writer.drain()
            return
        if self._writer.is_closing():  # nothing is drained here that would notice
            raise ConnectionResetError("the client has gone")
        self._last_s = max(self._last_s + NEXT_S, self._exposed_s + late_s)
        self._loop.call_at(self._last_s, self._write, data)
        await self._writer.drain()  # of earlier pictures: else a slow client would fall farther and farther behind

    def _write(self, data: bytes) -> None:
        if not self._writer.is_closing():
            self._writer.write(data)


class MjpegServer(LoopbackServer):
    """Serves `/stream.mjpg`. A client that reads too slowly is sent the newest image next, never a backlog."""

    def __init__(self, scene: Scene | Wall, view: View, faults: FaultBoard | None = None) -> None:
        """`view` gives the rate, the delay and the JPEG quality of the pictures."""
        super().__init__()
        self._scene = scene
        self._view = view
        self._period_s = 1.0 / view.fps
        self._quality = [cv2.IMWRITE_JPEG_QUALITY, view.jpeg_quality]
        self._rendering = asyncio.Lock()
        self._coded: deque[tuple[NDArray[np.uint8], bytes]] = deque(maxlen=NOISE_FIELDS)
        """The newest images of the scene and their JPEGs, reused while nothing changes."""
        self._faults = faults

    def show(self, scene: Scene | Wall, view: View) -> None:
        """Look at something else, with other settings. Every stream begins again, as when a camera is set up again."""
        self._scene, self._view = scene, view
        self._coded.clear()
        self.drop_clients()

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer any request with the stream."""
        async with asyncio.timeout(5.0):
            request = await reader.readuntil(b"\r\n\r\n")
        writer.write(
            b"HTTP/1.0 200 OK\r\nCache-Control: no-store\r\nServer: " + LOOPBACK_SERVER.encode() + b"\r\n"
            b"Content-Type: multipart/x-mixed-replace; boundary=" + BOUNDARY.encode() + b"\r\n\r\n"
        )
        if request.startswith(b"HEAD"):
            return
        await self._stream(writer)

    async def _stream(self, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        line = _Line(self._view, writer)
        held: deque[bytes] = deque(maxlen=BACKLOG)
        shown = b""
        while True:
            fault = self._faults.meet(Device.CAMERA) if self._faults is not None else None
            kind = "" if fault is None else fault.kind
            if kind == "frozen":
                held.append(renumbered(shown or await self._jpeg(line), time.time_ns()))
            else:
                jpeg = await self._jpeg(line)
                held.append(SPOILED[kind](jpeg) if kind in SPOILED else jpeg)
            if kind != "stale":
                sent = await self._send(held, line)
                shown = shown if kind in SPOILED else sent
            due = max(due + self._period_s, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _send(self, held: deque[bytes], line: _Line) -> bytes:
        """Send everything that is held, oldest first; return the last image."""
        image = b""
        while held:
            image = held.popleft()
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(image)}\r\n\r\n"
            await line.send(head.encode() + image + b"\r\n")
        return image

    async def _jpeg(self, line: _Line) -> bytes:
        async with self._rendering:  # the scene keeps a cache: one thread at a time
            tool = self._scene.tool()  # here, because the motion queue belongs to the event loop's thread
            line.exposed()
            return await asyncio.to_thread(self._encode, tool)

    def _encode(self, tool: Pose) -> bytes:
        image: NDArray[np.uint8] = self._scene.render(tool)
        for coded, data in self._coded:
            if coded is image:
                return data
        _, encoded = cv2.imencode(".jpg", image, self._quality)
        self._coded.append((image, data := encoded.tobytes()))
        return data
