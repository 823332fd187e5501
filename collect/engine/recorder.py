"""Puts what happens during a step attempt into its file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable
from typing import TYPE_CHECKING

from collect.engine.cadence import Arrivals, Sections
from drivers.clock import Clock
from drivers.samples import ForceSample, Frame, PoseSample, Stamp
from sessions.errors import SessionError
from sessions.recording.messages import (
    Transform,
    calibration_message,
    encode_png,
    image_message,
    joints_message,
    log_message,
    pose_message,
    transforms_message,
)
from sessions.recording.schemas import Event, InkState, Quality, StepEvent, Stroke, Topic, Wrench
from sessions.recording.writer import Outgoing, SegmentWriter

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from calibrate.board.lens import LensUsed

POSE_HZ = 100.0
"""What the driver asks of the arm."""


class Recorder:
    """One attempt's writer, spoken to in the engine's terms."""

    def __init__(
        self,
        writer: SegmentWriter,
        clock: Clock,
        force_hz: float | None = None,
        show: Callable[[Outgoing], None] | None = None,
    ) -> None:
        """`show` is handed every message as well, and neither waits nor raises."""
        self._writer = writer
        self._show = show
        self._clock = clock
        self._poses = Arrivals(Topic.TCP, POSE_HZ)
        self._forces = None if force_hz is None else Arrivals(Topic.WRENCH, force_hz)
        self._listeners: list[Callable[[PoseSample], None]] = []
        self.sections = Sections()

    @contextlib.contextmanager
    def also(self, on_sample: Callable[[PoseSample], None]) -> Generator[None]:
        """Hand every pose to one more listener, within the block."""
        self._listeners.append(on_sample)
        try:
            yield
        finally:
            self._listeners.remove(on_sample)

    def pose(self, sample: PoseSample) -> None:
        """A pose, and the joints where they came with it, stamped when the host got them."""
        stamp = sample.stamp
        for listener in self._listeners:
            listener(sample)
        self._poses.arrived(stamp.host_ns)
        self._sample(Topic.TCP, stamp, pose_message(stamp.host_ns, sample.pose.position_mm, sample.pose.quaternion))
        if sample.joints_rad is not None:
            names = [f"joint{number}" for number in range(1, len(sample.joints_rad) + 1)]
            self._sample(Topic.JOINTS, stamp, joints_message(stamp.host_ns, names, sample.joints_rad))

    def force(self, sample: ForceSample) -> None:
        """A sample of the force sensor, stamped when the host got it."""
        if self._forces is not None:
            self._forces.arrived(sample.stamp.host_ns)
        (fx, fy, fz), (mx, my, mz) = sample.force_n, sample.torque_nm
        wrench = Wrench(fx_n=fx, fy_n=fy, fz_n=fz, mx_nm=mx, my_nm=my, mz_nm=mz)
        self._sample(Topic.WRENCH, sample.stamp, wrench)

    def ink(self, level: float | None, dosed_ml: float, light: float | None) -> None:
        """The well before a dip."""
        now_ns = self._clock.now_ns()
        self._put(Topic.INK, now_ns, now_ns, 0, InkState(level=level, dosed_ml=dosed_ml, light=light))

    def frames(self, transforms: Iterable[Transform]) -> None:
        """Where the frames lie."""
        now_ns = self._clock.now_ns()
        self._put(Topic.TRANSFORMS, now_ns, now_ns, 0, transforms_message(now_ns, transforms))

    def optics(self, used: LensUsed) -> None:
        """The lens that photographs are straightened by before they are judged."""
        now_ns = self._clock.now_ns()
        message = calibration_message(now_ns, used.size_px, used.lens().matrix.tolist(), used.distortion)
        self._put(Topic.CALIBRATION, now_ns, now_ns, 0, message)

    def quality(self, quality: Quality, number: int) -> None:
        """The checks of the stroke that still `number` shows."""
        now_ns = self._clock.now_ns()
        self._put(Topic.QUALITY, now_ns, now_ns, number, quality)

    def cadence(self) -> None:
        """How steadily samples came so far, and what was slow: once, at the end of the step."""
        now_ns = self._clock.now_ns()
        slow = self.sections.report()
        for arrivals in (self._poses, self._forces):
            report = None if arrivals is None else arrivals.report(slow if arrivals is self._poses else ())
            if report is not None:
                self._put(Topic.CADENCE, now_ns, now_ns, 0, report)

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

    def _sample(self, topic: Topic, stamp: Stamp, message: Event | Message) -> None:
        # A failed disk must not end the telemetry that raised this; the step's next event hears of it.
        with contextlib.suppress(SessionError):
            self._put(topic, stamp.host_ns, stamp.device_ns or stamp.host_ns, stamp.seq, message)

    def _put(self, topic: Topic, log_ns: int, publish_ns: int, sequence: int, message: Event | Message) -> None:
        outgoing = Outgoing(topic, log_ns, publish_ns, sequence, message)
        self._writer.write(outgoing)
        if self._show is not None:
            self._show(outgoing)
