"""Newest values while a run goes on: force, target and picture for a screen; and `--live`, for a Foxglove viewer."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import queue
import threading
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np

from brushloop.collect.engine.snapshot import Picture
from brushloop.collect.errors import ConfigError
from brushloop.collect.photograph.frames import gray
from brushloop.collect.quality.measure import blur_px, busiest_tile
from brushloop.drivers.devices import Camera, ForceSample, Frame, Stamp
from brushloop.drivers.errors import DeviceError
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.mcap_writer import Outgoing, channel_of, encoded
from brushloop.sessions.messages import decode_gray, image_message
from brushloop.sessions.records import Topic

if TYPE_CHECKING:
    from foxglove import Channel

    from brushloop.sessions.messages import CompressedImage


SLOT_NS = 100_000_000
"""Time that one value of the trace covers. The value is the peak force, so that a short peak is seen."""
TRACE_SLOTS = 300
FRAME_PERIOD_S = 0.2
"""Time between two pictures of the camera."""
WIDTH_PX = 320


class Telemetry:
    """Newest values. Each write is short, and none waits for a reader."""

    def __init__(self) -> None:
        self.tip_mm: tuple[float, float, float] | None = None
        """Where the brush tip was last seen, however long ago."""
        self.picture: Picture | None = None
        self._lock = threading.Lock()
        self._peaks: deque[float] = deque(maxlen=TRACE_SLOTS)
        self._slot = -1

    def force(self, sample: ForceSample) -> None:
        """Take a sample of the force sensor; called at its full rate."""
        self.note_force(math.hypot(*sample.force_n), sample.stamp.host_ns)

    def note_force(self, force_n: float, t_ns: int) -> None:
        """Take a force in N at host time `t_ns`."""
        slot = t_ns // SLOT_NS
        with self._lock:
            if slot != self._slot:
                self._slot = slot
                self._peaks.append(force_n)
            elif self._peaks and force_n > self._peaks[-1]:
                self._peaks[-1] = force_n

    def trace_n(self) -> tuple[float, ...]:
        """Peak force of each tenth of a second, oldest first."""
        with self._lock:
            return tuple(self._peaks)


@contextlib.asynccontextmanager
async def each_frame(camera: Camera, show: Callable[[Frame], None]) -> AsyncGenerator[None]:
    """Within the block call `show`, in a thread, with the newest frame every `FRAME_PERIOD_S`. Never slows the run."""

    async def watch() -> None:
        while True:
            with contextlib.suppress(DeviceError):  # the run finds out when it takes a photograph itself
                await asyncio.to_thread(show, await camera.fresh(Stamp(0)))
            await asyncio.sleep(FRAME_PERIOD_S)

    task = asyncio.create_task(watch(), name="camera picture")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@contextlib.asynccontextmanager
async def previewing(telemetry: Telemetry, camera: Camera, *, wanted: bool) -> AsyncGenerator[None]:
    """Within the block keep `telemetry.picture` up to date, if `wanted`."""
    numbers = itertools.count()

    def show(frame: Frame) -> None:
        telemetry.picture = _picture_of(frame, next(numbers))

    async with each_frame(camera, show) if wanted else contextlib.nullcontext():
        yield


def _picture_of(frame: Frame, number: int) -> Picture:
    image = gray(frame.image)
    height, width = image.shape
    size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Picture(number, small, blur_px(busiest_tile(image)))


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
