"""Puts what happens during a step attempt into its file."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from drivers.clock import Clock
from drivers.samples import Frame, PoseSample
from sessions.errors import SessionError
from sessions.messages import encode_png, image_message, log_message, pose_message
from sessions.schemas import Event, StepEvent, Stroke, Topic
from sessions.writer import Outgoing, SegmentWriter

if TYPE_CHECKING:
    from google.protobuf.message import Message


class Recorder:
    """One attempt's writer, spoken to in the engine's terms."""

    def __init__(self, writer: SegmentWriter, clock: Clock) -> None:
        self._writer = writer
        self._clock = clock

    def pose(self, sample: PoseSample) -> None:
        """A pose, stamped when the host got it."""
        stamp = sample.stamp
        message = pose_message(stamp.host_ns, sample.pose.position_mm, sample.pose.quaternion)
        # A failed disk must not end the telemetry that raised this; the step's next event hears of it.
        with contextlib.suppress(SessionError):
            self._put(Topic.TCP, stamp.host_ns, stamp.device_ns or stamp.host_ns, stamp.seq, message)

    def still(self, frame: Frame, number: int) -> None:
        """A lossless still; `number` is unique in the session. Encoding takes tens of ms: call it off the loop."""
        stamp = frame.stamp
        message = image_message(stamp.host_ns, encode_png(frame.image))
        self._put(Topic.STILL, self._clock.now_ns(), stamp.host_ns, number, message)

    def stroke(self, stroke: Stroke) -> None:
        """A captured stroke; after its still."""
        now_ns = self._clock.now_ns()
        self._put(Topic.STROKE, now_ns, now_ns, stroke.still, stroke)

    def step(self, event: StepEvent) -> None:
        """Begin or end of the step."""
        now_ns = self._clock.now_ns()
        self._put(Topic.STEP, now_ns, now_ns, event.index, event)

    def log(self, text: str, *, warning: bool = False) -> None:
        """A line of the log."""
        now_ns = self._clock.now_ns()
        self._put(Topic.LOG, now_ns, now_ns, 0, log_message(now_ns, text, warning=warning))

    def _put(self, topic: Topic, log_ns: int, publish_ns: int, sequence: int, message: Event | Message) -> None:
        self._writer.write(Outgoing(topic, log_ns, publish_ns, sequence, message))
