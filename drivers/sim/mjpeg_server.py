"""The loopback camera: an MJPEG stream over HTTP, one new image per period to every client that keeps up."""

from __future__ import annotations

import asyncio
import time

import cv2

from drivers.camera.options import LOOPBACK_SERVER
from drivers.samples import Pose
from drivers.sim.scene import Scene
from drivers.sim.server import LoopbackServer

BOUNDARY = "brushloop"


class MjpegServer(LoopbackServer):
    """Serves `/stream.mjpg`. A client that does not drain is sent the newest image next, never a backlog."""

    def __init__(self, scene: Scene, *, fps: float, jpeg_quality: int) -> None:
        super().__init__()
        self._scene = scene
        self._period_s = 1.0 / fps
        self._quality = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
        self._rendering = asyncio.Lock()

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
        while True:
            image = await self._jpeg()
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(image)}\r\n\r\n"
            writer.write(head.encode() + image + b"\r\n")
            await writer.drain()
            due = max(due + self._period_s, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _jpeg(self) -> bytes:
        async with self._rendering:  # the scene keeps a cache: one thread at a time
            # The stamp first, so that no frame shows anything older than it says; the tool here, because the
            # motion queue belongs to the event loop's thread.
            host_ns, tool = time.time_ns(), self._scene.tool()
            return await asyncio.to_thread(self._encode, host_ns, tool)

    def _encode(self, host_ns: int, tool: Pose) -> bytes:
        _, encoded = cv2.imencode(".jpg", self._scene.render(host_ns, tool), self._quality)
        return encoded.tobytes()
