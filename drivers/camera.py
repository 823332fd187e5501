"""A camera behind OpenCV's VideoCapture, read without pause so that no frame is older than it looks.

An unread capture hands back frames that are seconds old (its buffer cannot be shortened). A grabber thread
reads all the time and keeps only the newest; `fresh` then waits for one that was exposed late enough.
"""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from drivers.clock import Clock
from drivers.errors import ConnectionLost, DeviceTimeout, NotConnected
from drivers.samples import Frame, Identity, Stamp

if TYPE_CHECKING:
    import cv2
    import numpy as np
    from numpy.typing import NDArray

DEVICE = "camera"


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """`source` is a stream URL, a file, or a device number as text."""

    source: str
    latency_ms: float = 250.0
    """The longest time from exposure to arrival; a frame counts as exposed after (arrival - latency)."""
    timeout_s: float = 10.0
    gray: bool = True
    """Ink on paper has no colour worth three times the disk."""


class OpenCvCamera:
    """`Camera` over one `cv2.VideoCapture`; the grabber thread owns it from open to release."""

    def __init__(self, options: CameraOptions, clock: Clock) -> None:
        self._options = options
        self._clock = clock
        self._condition = threading.Condition()
        self._newest: Frame | None = None
        self._ended: str | None = None
        self._closing = threading.Event()  # one for each grabber: an old one that hangs must not wake up again
        self._thread: threading.Thread | None = None

    async def connect(self) -> Identity:
        """Start the grabber and wait for its first frame. Raises `ConnectionLost` or `DeviceTimeout`."""
        self._newest, self._ended, self._closing = None, None, threading.Event()
        self._thread = threading.Thread(target=self._grab, args=(self._closing,), name="camera grabber", daemon=True)
        self._thread.start()
        try:
            frame = await self.fresh(Stamp(0))
        except BaseException:
            await self.close()
            raise
        height, width = frame.image.shape[:2]
        return Identity(DEVICE, f"{self._options.source} {width}x{height}", "", False)

    async def fresh(self, after: Stamp) -> Frame:
        """The first frame exposed after `after.host_ns`. Raises `DeviceTimeout`, `ConnectionLost`."""
        if self._thread is None:
            raise NotConnected(DEVICE, "fresh", "not connected")
        return await asyncio.to_thread(self._wait_for, after.host_ns)

    async def close(self) -> None:
        """End the grabber and wait for it; a read that hangs is left to the daemon thread."""
        self._closing.set()
        with self._condition:
            self._condition.notify_all()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, 5.0)
            self._thread = None

    def _wait_for(self, after_ns: int) -> Frame:
        def late_enough() -> Frame | None:
            frame = self._newest
            return frame if frame is not None and frame.exposed_after_ns >= after_ns else None

        def over() -> bool:
            return self._ended is not None or self._closing.is_set()

        with self._condition:
            if not self._condition.wait_for(lambda: late_enough() or over(), self._options.timeout_s):
                raise DeviceTimeout(
                    DEVICE,
                    "fresh",
                    f"no new frame from {self._options.source} in {self._options.timeout_s:g} s",
                    remedy="Check cable and stream; the arm does not move meanwhile.",
                )
            frame = late_enough()
            if frame is None or over():
                raise ConnectionLost(DEVICE, "fresh", self._ended or "closed while waiting")
            return frame

    def _grab(self, closing: threading.Event) -> None:
        import cv2

        source = self._options.source
        opening_ns = self._clock.now_ns()
        timeout_ms = round(self._options.timeout_s * 1e3)
        # One decoder thread: frame-parallel decoding would hold every frame back by one or more periods.
        stream = [
            *(cv2.CAP_PROP_N_THREADS, 1),
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, timeout_ms),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, timeout_ms),
        ]
        capture = (
            cv2.VideoCapture(int(source)) if source.isdecimal() else cv2.VideoCapture(source, cv2.CAP_FFMPEG, stream)
        )
        why = "the grabber failed"
        try:
            why = self._read_all(capture, closing, opening_ns)
        finally:
            capture.release()
            if not closing.is_set():
                self._end(why)

    def _read_all(self, capture: cv2.VideoCapture, closing: threading.Event, opening_ns: int) -> str:
        """Why it ended."""
        import cv2

        if not capture.isOpened():
            return f"cannot open {self._options.source}"
        seq = 0
        while not closing.is_set():
            ok, raw = capture.read()
            arrival_ns = self._clock.now_ns()
            if not ok:
                return f"{self._options.source} ended after {seq} frames"
            image = cast("NDArray[np.uint8]", raw)
            if self._options.gray and image.ndim == 3:
                image = cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
            # The first frame was read to learn the format, and waited until the capture was open.
            exposed_ns = (arrival_ns if seq else opening_ns) - round(self._options.latency_ms * 1e6)
            with self._condition:
                self._newest = Frame(Stamp(arrival_ns, None, seq), exposed_ns, image)
                self._condition.notify_all()
            seq += 1
        return "closed"

    def _end(self, why: str) -> None:
        with self._condition:
            self._ended = why
            self._condition.notify_all()
