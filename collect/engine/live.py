"""`--live`: what is being recorded, for a Foxglove viewer on this machine. Looks on; never slows the run.

Messages wait in a short queue for a thread of their own; where that is full they are dropped and counted. What is
recorded does not pass through here.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import time
from collections.abc import AsyncGenerator, Callable
from typing import TYPE_CHECKING, Any, cast

from collect.errors import ConfigError
from drivers.errors import DeviceError
from drivers.protocols import Camera
from drivers.samples import Frame, Stamp
from sessions.errors import SessionDamaged
from sessions.recording.messages import decode_gray, image_message
from sessions.recording.schemas import Topic
from sessions.recording.writer import ChannelTable, Outgoing

if TYPE_CHECKING:
    from foxglove import Channel
    from mcap.writer import Writer

    from sessions.recording.messages import CompressedImage

HOST = "127.0.0.1"
"""This machine only, and not to be configured: a viewer needs no password."""
PORT = 8765
"""Where Foxglove looks by itself."""
QUEUE_LIMIT = 2000
"""About two seconds of everything, the force at 1 kHz included."""
BACKLOG = 1024
"""Messages that wait for one slow viewer; the oldest are dropped."""
PREVIEW_S = 0.2
"""Between two pictures."""
PREVIEW_PX = 1024
"""The longer side of a preview."""
JPEG_QUALITY = 80


class LiveView:
    """A server for viewers, from `start` to `close`. `offer` and `frame` may be called from any thread, always."""

    def __init__(self, port: int = PORT) -> None:
        self.port = port
        self.sent = 0
        """Messages that went to at least one viewer."""
        self.dropped = 0
        """Messages for which there was no room; of pictures, only those that were due."""
        self._queue: queue.Queue[Outgoing | Frame | None] = queue.Queue(QUEUE_LIMIT)
        self._next_preview_s = 0.0
        self._thread: threading.Thread | None = None
        self._server: Any = None
        self._closing = threading.Event()

    def start(self) -> None:
        """Listen, on 127.0.0.1 only. Raises `ConfigError` without foxglove-sdk, or where the port is taken."""
        try:
            import foxglove
        except ImportError:
            raise ConfigError("--live", "", "needs foxglove-sdk: pip install 'brushloop[live]'") from None
        # A viewer that leaves without a word is no news, and no line across the operator's screen.
        foxglove.set_log_level("CRITICAL")
        context = foxglove.Context()
        try:
            # No capability: a viewer can look and nothing else.
            self._server = foxglove.start_server(
                name="brushloop", host=HOST, port=self.port, context=context, message_backlog_size=BACKLOG
            )
        except RuntimeError as error:
            raise ConfigError("--live", "", f"cannot listen on {HOST}:{self.port}: {error}") from None
        self.port = int(self._server.port)
        self._thread = threading.Thread(target=self._run, args=(_Channels(context),), name="live view", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """For "Open connection" in Foxglove."""
        return f"ws://{HOST}:{self.port}"

    def offer(self, outgoing: Outgoing) -> None:
        """Show a message that is being recorded; returns at once, and never raises. A still becomes a preview."""
        if outgoing.topic is not Topic.STILL or self._preview_is_due():
            self._put(outgoing)

    def frame(self, frame: Frame) -> None:
        """Show a camera frame, at most one each `PREVIEW_S`; returns at once, and never raises."""
        if self._preview_is_due():
            self._put(frame)

    def close(self) -> None:
        """End the thread, then the server; what still waits is not shown."""
        self._closing.set()
        if self._thread is not None:
            with contextlib.suppress(queue.Full):
                self._queue.put_nowait(None)  # wakes it up; where there is no room it is awake
            self._thread.join()
            self._thread = None
        if self._server is not None:
            self._server.stop()
            self._server = None

    def _preview_is_due(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_preview_s:
            return False
        self._next_preview_s = now_s + PREVIEW_S
        return True

    def _put(self, item: Outgoing | Frame) -> None:
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _run(self, channels: _Channels) -> None:
        # The same code as for the file registers topics and schemas, so that they are the same.
        table = ChannelTable(cast("Writer", channels))
        while not self._closing.is_set():
            item = self._queue.get()
            if item is None:
                continue
            picture = isinstance(item, Frame) or item.topic is Topic.STILL
            # Nothing is encoded for nobody.
            if channels.watched(Topic.PREVIEW if picture else cast("Outgoing", item).topic):
                with contextlib.suppress(SessionDamaged):
                    table.add(_preview(item) if picture else cast("Outgoing", item))
        self.sent = channels.sent


@contextlib.asynccontextmanager
async def watching(live: LiveView | None, camera: Camera, tell: Callable[[str], None]) -> AsyncGenerator[None]:
    """Within the block show the camera's newest frame, and `tell` where to look; without `live` do nothing."""
    if live is None:
        yield
        return
    tell(f"live view: {live.url}")
    watch = asyncio.create_task(_watch(live, camera), name="live view")
    try:
        yield
    finally:
        watch.cancel()
        await asyncio.gather(watch, return_exceptions=True)
        if live.dropped:
            tell(f"live view: {live.dropped} messages were not shown; all are recorded")


async def _watch(live: LiveView, camera: Camera) -> None:
    while True:
        with contextlib.suppress(DeviceError):  # the run hears of it by its own question
            live.frame(await camera.fresh(Stamp(0)))
        await asyncio.sleep(PREVIEW_S)


class _Channels:
    """What `ChannelTable` needs of an MCAP writer, over a viewer's channels."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._schemas: list[Any] = []
        self._channels: list[Channel] = []
        self._topics: dict[str, int] = {}
        self.sent = 0

    def register_schema(self, *, name: str, encoding: str, data: bytes) -> int:
        from foxglove import Schema

        self._schemas.append(Schema(name=name, encoding=encoding, data=data))
        return len(self._schemas) - 1

    def register_channel(self, *, topic: str, message_encoding: str, schema_id: int) -> int:
        from foxglove import Channel

        schema = self._schemas[schema_id]
        self._channels.append(
            Channel(str(topic), schema=schema, message_encoding=message_encoding, context=self._context)
        )
        self._topics[topic] = len(self._channels) - 1
        return self._topics[topic]

    def add_message(self, *, channel_id: int, log_time: int, data: bytes, **_: int) -> None:
        channel = self._channels[channel_id]
        if channel.has_sinks():
            channel.log(data, log_time=log_time)
            self.sent += 1

    def flush(self) -> None:
        """Nothing waits here."""

    def watched(self, topic: Topic) -> bool:
        """Whether a viewer wants it; True as well where no viewer can know of it yet."""
        known = self._topics.get(topic)
        return known is None or self._channels[known].has_sinks()


def _preview(item: Outgoing | Frame) -> Outgoing:
    """A JPEG of a frame or of a recorded still. Raises `SessionDamaged`."""
    import cv2

    if isinstance(item, Frame):
        image, log_ns, publish_ns = item.image, item.stamp.host_ns, item.stamp.host_ns
    else:
        image = decode_gray(cast("CompressedImage", item.message).data, "a still")
        log_ns, publish_ns = item.log_ns, item.publish_ns
    shrink = PREVIEW_PX / max(image.shape[:2])
    if shrink < 1.0:
        image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return Outgoing(Topic.PREVIEW, log_ns, publish_ns, 0, image_message(publish_ns, encoded.tobytes(), "jpeg"))
