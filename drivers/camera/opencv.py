"""A camera that is read without pause, so that no frame is older than it looks.

An unread capture hands back frames that are seconds old (its buffer cannot be shortened). A grabber thread
reads all the time and keeps only the newest valid frame; `fresh` then waits for one that was exposed late enough.
A live source that ends is opened again, with a notice.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

from brushloop.drivers.camera.health import FrameHealth
from brushloop.drivers.camera.source import DEVICE, CameraOptions, Source, open_source
from brushloop.drivers.clock import Clock
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, NotConnected
from brushloop.drivers.samples import Frame, Identity, Stamp

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

REOPEN_AFTER_S = 0.5
LASTING_NS = 1_000_000_000
JOIN_S = 5.0
QUIET_NS = 30_000_000_000
"""Time without a faulty frame after which faulty frames are worth another notice."""


class OpenCvCamera:
    """`Camera` over one source. Each connection has its own grabber, so no frame outlives its connection."""

    def __init__(
        self, options: CameraOptions, clock: Clock, on_notice: Callable[[str], None] = lambda _text: None
    ) -> None:
        self._options = options
        self._clock = clock
        self._on_notice = on_notice
        self._grabber: _Grabber | None = None

    async def connect(self) -> Identity:
        """Start the grabber and wait for its first valid frame. Raises `ConnectionLost`, `DeviceError`, ..."""
        grabber = self._grabber = _Grabber(self._options, self._clock, self._on_notice)
        grabber.thread.start()
        try:
            frame = await self.fresh(Stamp(0))
        except BaseException:
            await self.close()
            raise
        height, width = frame.image.shape[:2]
        locked = "".join(f", {name} {value:g}" for name, value in grabber.settings.items())
        return Identity(DEVICE, f"{self._options.source} {width}x{height}{locked}", "", grabber.simulated)

    async def fresh(self, after: Stamp) -> Frame:
        """The first valid frame exposed after `after.host_ns`. Raises `DeviceTimeout`, `ConnectionLost`."""
        if self._grabber is None:
            raise NotConnected(DEVICE, "fresh", "not connected")
        return await asyncio.to_thread(self._grabber.wait_for, after.host_ns)

    async def close(self) -> None:
        """End the grabber and wait for it; a read that hangs is left to the daemon thread."""
        grabber = self._grabber
        if grabber is not None:
            grabber.end()
            await asyncio.to_thread(grabber.thread.join, JOIN_S)
            self._grabber = None


class _Grabber:
    """The frames of one connection; its thread owns the source from open to release."""

    def __init__(self, options: CameraOptions, clock: Clock, on_notice: Callable[[str], None]) -> None:
        self._options = options
        self._clock = clock
        self._on_notice = on_notice
        self._condition = threading.Condition()
        self._newest: Frame | None = None
        self._trouble = ""
        """Why no valid frame arrives, for the message of a timeout."""
        self._reported = False
        self._ended: DeviceError | None = None
        self._closing = threading.Event()
        self.thread = threading.Thread(target=self._grab, name="camera grabber", daemon=True)
        self.settings: dict[str, float] = {}
        self.simulated = False

    def end(self) -> None:
        """Wake up whoever waits for a frame, and let the thread end after its current read."""
        self._closing.set()
        with self._condition:
            self._condition.notify_all()

    def wait_for(self, after_ns: int) -> Frame:
        """The first frame exposed after `after_ns`; blocks. Raises `DeviceTimeout`, `ConnectionLost`."""

        def late_enough() -> Frame | None:
            frame = self._newest
            return frame if frame is not None and frame.exposed_after_ns >= after_ns else None

        def over() -> bool:
            return self._ended is not None or self._closing.is_set()

        with self._condition:
            if not self._condition.wait_for(lambda: late_enough() or over(), self._options.timeout_s):
                why = f" ({self._trouble})" if self._trouble else ""
                raise DeviceTimeout(
                    DEVICE,
                    "fresh",
                    f"no valid new frame from {self._options.source} in {self._options.timeout_s:g} s{why}",
                    remedy="Check cable, light and stream; the arm does not move meanwhile.",
                )
            frame = late_enough()
            if frame is not None and not self._closing.is_set():
                return frame
            raise self._ended or ConnectionLost(DEVICE, "fresh", "closed while waiting")

    def _grab(self) -> None:
        lost_ns: int | None = None
        try:
            while not self._closing.is_set():
                opening_ns = self._clock.now_ns()
                try:
                    source = open_source(self._options)
                except ConnectionLost:
                    if lost_ns is None:
                        raise
                    self._closing.wait(REOPEN_AFTER_S)
                    continue
                try:
                    if lost_ns is not None:
                        self._on_notice(f"camera is back after {(self._clock.now_ns() - lost_ns) / 1e9:.1f} s")
                    self._read_all(source, opening_ns)
                finally:
                    source.release()
                if self._closing.is_set():
                    return
                if not source.live:
                    raise ConnectionLost(DEVICE, "read", f"{self._options.source} ended")
                lost_ns = self._clock.now_ns()
                self._report("the stream ended and is opened again")
                self._closing.wait(REOPEN_AFTER_S)
        except DeviceError as error:
            self._fail(error)
        except BaseException as error:
            self._fail(DeviceError(DEVICE, "read", f"the grabber failed: {error!r}"))
            raise

    def _read_all(self, source: Source, opening_ns: int) -> None:
        """Read until the source ends; only valid frames are kept."""
        import cv2

        self.settings, self.simulated = source.settings, source.simulated
        latency_ns = round(self._options.latency_ms * 1e6)
        health = FrameHealth(
            latency_ns=latency_ns,
            frozen_after=self._options.frozen_after,
            live=source.live,
            independent=source.independent,
        )
        first, valid_ns, faulty_ns = True, opening_ns, opening_ns - QUIET_NS
        while not self._closing.is_set():
            image = source.read()
            arrival_ns = self._clock.now_ns()
            if image is None:
                return
            if image.ndim == 3:  # the colour of ink on paper is not worth three times the disk space
                image = cast("NDArray[np.uint8]", cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
            fault = health.judge(image, arrival_ns)
            if fault is not None:
                # Single faulty frames happen; one second without a valid frame is reported.
                self._report(health.describe(fault), aloud=arrival_ns - valid_ns > LASTING_NS)
                faulty_ns = arrival_ns
                continue
            valid_ns = arrival_ns
            if health.repeated:
                continue  # it arrived now, but was exposed when its first copy was
            # The first frame was read to learn the format, and waited until the capture was open.
            exposed_ns = (opening_ns if first else arrival_ns) - latency_ns
            first = False
            with self._condition:
                seq = self._newest.stamp.seq + 1 if self._newest is not None else 0
                self._newest = Frame(Stamp(arrival_ns, None, seq), exposed_ns, image)
                self._trouble, self._reported = "", self._reported and arrival_ns - faulty_ns < QUIET_NS
                self._condition.notify_all()

    def _report(self, text: str, *, aloud: bool = True) -> None:
        with self._condition:
            self._trouble = text
            notify = aloud and not self._reported and not self._closing.is_set()
            self._reported = self._reported or notify
        if notify:
            self._on_notice(f"camera: {text}")

    def _fail(self, error: DeviceError) -> None:
        with self._condition:
            self._ended = error
            self._condition.notify_all()
