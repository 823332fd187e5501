"""`--live`: shows what is being recorded in a Foxglove viewer on this machine, without slowing the run.

A thread sends the messages from a short queue; when the queue is full, messages are dropped and counted. Recording
does not pass through here.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import AsyncGenerator, Callable
from typing import TYPE_CHECKING, Any, cast

from brushloop.collect.engine.telemetry import FRAME_PERIOD_S, each_frame
from brushloop.collect.errors import ConfigError
from brushloop.drivers.devices import Camera, Frame
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.mcap_writer import Outgoing, channel_of, encoded
from brushloop.sessions.messages import decode_gray, image_message
from brushloop.sessions.records import Topic

if TYPE_CHECKING:
    from foxglove import Channel

    from brushloop.sessions.messages import CompressedImage

HOST = "127.0.0.1"
"""Loopback only, and not configurable, because a viewer needs no password."""
PORT = 8765
"""The default port of Foxglove."""
QUEUE_LIMIT = 2000
"""About two seconds of all messages, with the force at 1 kHz."""
BACKLOG = 1024
"""Messages that may wait for one slow viewer; the oldest are dropped."""
PREVIEW_PX = 1024
"""Longer side of a preview."""
JPEG_QUALITY = 80


class LiveView:
    """A server for viewers, from `start` to `close`. `offer` and `frame` may be called at any time, from any thread."""

    def __init__(self, port: int = PORT) -> None:
        self.port = port
        self.dropped = 0
        """Messages dropped because the queue was full; pictures count only if one was due."""
        self._queue: queue.Queue[Outgoing | Frame | None] = queue.Queue(QUEUE_LIMIT)
        self._next_preview_s = 0.0
        self._thread: threading.Thread | None = None
        self._server: Any = None
        self._closing = threading.Event()

    def start(self) -> None:
        """Listen, on 127.0.0.1 only. Raises `ConfigError` if foxglove-sdk is missing or the port is taken."""
        try:
            import foxglove
        except ImportError:
            raise ConfigError("--live", "", "needs foxglove-sdk: pip install 'brushloop[live]'") from None
        # Otherwise a viewer that disconnects would cause log lines across the operator's screen.
        foxglove.set_log_level("CRITICAL")
        context = foxglove.Context()
        try:
            # No capabilities: a viewer can only look.
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
        """Address to enter at "Open connection" in Foxglove."""
        return f"ws://{HOST}:{self.port}"

    def offer(self, outgoing: Outgoing) -> None:
        """Show a message that is being recorded, a still as a preview; returns at once and never raises."""
        if outgoing.topic is not Topic.STILL or self._preview_is_due():
            self._put(outgoing)

    def frame(self, frame: Frame) -> None:
        """Show a camera frame, at most one every `FRAME_PERIOD_S`; returns at once and never raises."""
        if self._preview_is_due():
            self._put(frame)

    def close(self) -> None:
        """End the thread, then the server; waiting messages are not shown."""
        self._closing.set()
        if self._thread is not None:
            with contextlib.suppress(queue.Full):
                self._queue.put_nowait(None)  # wakes the thread; if the queue is full, it is awake already
            self._thread.join()
            self._thread = None
        if self._server is not None:
            self._server.stop()
            self._server = None

    def _preview_is_due(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_preview_s:
            return False
        self._next_preview_s = now_s + FRAME_PERIOD_S
        return True

    def _put(self, item: Outgoing | Frame) -> None:
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _run(self, channels: _Channels) -> None:
        while not self._closing.is_set():
            item = self._queue.get()
            if item is None:
                continue
            picture = isinstance(item, Frame) or item.topic is Topic.STILL
            # Encode nothing while no viewer is subscribed.
            if channels.watched(Topic.PREVIEW if picture else cast("Outgoing", item).topic):
                with contextlib.suppress(SessionDamaged):
                    channels.show(_preview(item) if picture else cast("Outgoing", item))


@contextlib.asynccontextmanager
async def watching(live: LiveView | None, camera: Camera, log: Callable[[str], None]) -> AsyncGenerator[None]:
    """Show the camera's newest frames during the block, and `log` the address; do nothing if `live` is None."""
    if live is None:
        yield
        return
    log(f"live view: {live.url}")
    try:
        async with each_frame(camera, live.frame):
            yield
    finally:
        if live.dropped:
            log(f"live view: {live.dropped} messages were not shown; all are recorded")


class _Channels:
    """The topics that a viewer is offered, with the schemas that files have too."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._channels: dict[Topic, Channel] = {}

    def show(self, outgoing: Outgoing) -> None:
        """Send a message to whoever subscribed to its topic, which is advertised at its first message."""
        import foxglove

        channel = self._channels.get(outgoing.topic)
        if channel is None:
            schema, record = channel_of(outgoing.topic, type(outgoing.message))
            described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            channel = self._channels[outgoing.topic] = foxglove.Channel(
                record.topic, schema=described, message_encoding=record.message_encoding, context=self._context
            )
        if channel.has_sinks():
            channel.log(encoded(outgoing.message), log_time=outgoing.log_ns)

    def watched(self, topic: Topic) -> bool:
        """Whether a viewer subscribed to the topic; also True where it has not been advertised yet."""
        known = self._channels.get(topic)
        return known is None or known.has_sinks()


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
