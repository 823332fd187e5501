"""The loopback camera: an MJPEG stream over HTTP, one new image per period to every client that keeps up."""

from __future__ import annotations

import asyncio
import time
from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.camera.options import LOOPBACK_SERVER
from drivers.samples import Pose
from drivers.sim.faults.board import FaultBoard
from drivers.sim.faults.pictures import dark, retold, torn
from drivers.sim.faults.vocabulary import KINDS, Device
from drivers.sim.scene import Scene
from drivers.sim.server import LoopbackServer

BOUNDARY = "brushloop"
BACKLOG = 64
"""Images that a stalled stream keeps, as the buffers of a real one do."""


class MjpegServer(LoopbackServer):
    """Serves `/stream.mjpg`. A client that does not drain is sent the newest image next, never a backlog."""

    def __init__(self, scene: Scene, *, fps: float, jpeg_quality: int) -> None:
        super().__init__()
        self._scene = scene
        self._period_s = 1.0 / fps
        self._quality = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
        self._rendering = asyncio.Lock()
        self.faults: FaultBoard | None = None
        """What goes wrong here; a rig puts one board in all its servers."""

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
        held: deque[bytes] = deque(maxlen=BACKLOG)
        shown = b""
        while True:
            match self._fault():
                case "drop":
                    return
                case "stale":
                    held.append(await self._jpeg())
                case "black":
                    held.append(await self._jpeg(black=True))
                    shown = await self._send(held, writer)
                case "frozen":
                    held.append(retold(shown or await self._jpeg(), time.time_ns()))
                    shown = await self._send(held, writer)
                case "torn":
                    held.append(torn(await self._jpeg()))
                    await self._send(held, writer)
                case _:
                    held.append(await self._jpeg())
                    shown = await self._send(held, writer)
            due = max(due + self._period_s, loop.time())
            await asyncio.sleep(due - loop.time())

    def _fault(self) -> str:
        fault = self.faults.meet(Device.CAMERA, "frame", KINDS[Device.CAMERA]) if self.faults is not None else None
        return fault.kind if fault is not None else ""

    async def _send(self, held: deque[bytes], writer: asyncio.StreamWriter) -> bytes:
        """Everything that is held, oldest first; returns the last."""
        image = b""
        while held:
            image = held.popleft()
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(image)}\r\n\r\n"
            writer.write(head.encode() + image + b"\r\n")
            await writer.drain()
        return image

    async def _jpeg(self, *, black: bool = False) -> bytes:
        async with self._rendering:  # the scene keeps a cache: one thread at a time
            # The stamp first, so that no frame shows anything older than it says; the tool here, because the
            # motion queue belongs to the event loop's thread.
            host_ns, tool = time.time_ns(), self._scene.tool()
            return await asyncio.to_thread(self._encode, host_ns, tool, black)

    def _encode(self, host_ns: int, tool: Pose, black: bool) -> bytes:
        image: NDArray[np.uint8] = self._scene.render(host_ns, tool)
        _, encoded = cv2.imencode(".jpg", dark(image.shape, host_ns) if black else image, self._quality)
        return encoded.tobytes()
