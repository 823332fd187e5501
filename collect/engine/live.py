"""`--live`, which shows a run in a Foxglove viewer while it goes on."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from brushloop.collect.errors import ConfigError
from brushloop.drivers.devices import Frame
from brushloop.sessions.mcap_writer import Outgoing, channel_of, encoded
from brushloop.sessions.messages import image_message
from brushloop.sessions.records import Event, Topic

if TYPE_CHECKING:
    from foxglove import Channel
    from google.protobuf.message import Message


def no_wider(image: NDArray[np.uint8], width_px: int) -> NDArray[np.uint8]:
    """The image, reduced if it is wider."""
    scale = min(1.0, width_px / image.shape[1])
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


HOST = "127.0.0.1"
"""Loopback only, and not configurable, because a viewer needs no password."""
BACKLOG = 1024
"""Messages that may wait for one slow viewer; the oldest are dropped."""
PREVIEW_PX = 1024
"""Largest width of a preview."""
JPEG_QUALITY = 80


class LiveView:
    """A server for viewers, until `close`. `offer` and `frame` may be called at any time, from any thread.

    Neither waits for a viewer, and nothing is encoded for a topic that nobody watches.
    """

    def __init__(self, port: int) -> None:
        """Listen, on 127.0.0.1 only. Raises `ConfigError` if foxglove-sdk is missing or the port is taken."""
        try:
            import foxglove
        except ImportError:
            raise ConfigError("--live", "", "needs foxglove-sdk: pip install 'brushloop[live]'") from None
        # Otherwise a viewer that disconnects would cause log lines across the operator's screen.
        foxglove.set_log_level("CRITICAL")
        self._context: Any = foxglove.Context()
        self._lock = threading.Lock()
        self._channels: dict[Topic, Channel] = {}
        try:
            # No capabilities: a viewer can only look.
            self._server: Any = foxglove.start_server(
                name="brushloop", host=HOST, port=port, context=self._context, message_backlog_size=BACKLOG
            )
        except RuntimeError as error:
            raise ConfigError("--live", "", f"cannot listen on {HOST}:{port}: {error}") from None
        self.port = int(self._server.port)
        self.url = f"ws://{HOST}:{self.port}"
        """Address to enter at "Open connection" in Foxglove."""

    def offer(self, outgoing: Outgoing) -> None:
        """Show a message that is being recorded. Stills are not sent: `frame` shows what the camera sees."""
        if outgoing.topic is not Topic.STILL:
            channel = self._channel(outgoing.topic, type(outgoing.message))
            if channel.has_sinks():
                channel.log(encoded(outgoing.message), log_time=outgoing.log_ns)

    def frame(self, frame: Frame) -> None:
        """Show a camera frame as a small JPEG."""
        stamp_ns = frame.stamp.host_ns
        if self._channel(Topic.PREVIEW, CompressedImage).has_sinks():
            small = no_wider(frame.image, PREVIEW_PX)
            _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            message = image_message(stamp_ns, jpeg.tobytes(), "jpeg")
            self.offer(Outgoing(Topic.PREVIEW, stamp_ns, stamp_ns, 0, message))

    def close(self) -> None:
        """End the server."""
        self._server.stop()

    def _channel(self, topic: Topic, kind: type[Event | Message]) -> Channel:
        """The channel of a topic, with the schema that files have too; it is advertised at its first message."""
        import foxglove

        with self._lock:
            if topic not in self._channels:
                schema, record = channel_of(topic, kind)
                self._channels[topic] = foxglove.Channel(
                    record.topic,
                    schema=foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
                    message_encoding=record.message_encoding,
                    context=self._context,
                )
            return self._channels[topic]
