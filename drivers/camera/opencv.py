"""A camera that is read without pause, so that no frame is older than it looks.

An unread capture hands back frames that are seconds old (its buffer cannot be shortened). A grabber thread
reads all the time and keeps only the newest valid frame; `fresh` then waits for one that was exposed late enough.
A live source that ends is opened again, with a notice. Black, saturated, torn, frozen and late frames are named and
skipped.
"""

from __future__ import annotations

import asyncio
import threading
import zlib
from collections import Counter, deque
from collections.abc import Callable
from enum import StrEnum
from typing import TYPE_CHECKING, cast

from brushloop.drivers.camera.source import DEVICE, CameraTable, CaptureSource
from brushloop.drivers.devices import Frame, Identity, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, NotConnected
from brushloop.drivers.host import Clock

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SAMPLE_STEP = 7
"""Pixels are sampled at this step in both directions; a prime, so that no pattern hides between them."""
BLACK_BELOW = 25
LIGHT_SHARE = 0.005
"""A frame in which fewer of the sampled pixels than this are lighter than `BLACK_BELOW` is black."""
SATURATED_SHARE = 0.5
TORN_BAND_SHARE = 0.02
"""Share of the rows, at the bottom, that are uniform if the decoder ran out of data."""
END_ROWS = 16
"""Height of the last row of blocks of a JPEG."""
FROZEN_AFTER = 5
"""Number of identical consecutive frames that mean a frozen camera; real frames have noise."""
BURST_SHARE = 0.5
"""Frames that arrive within less than this share of the usual period are a backlog."""
PERIODS_KEPT = 31
PERIODS_LEARNED = 3
"""Number of gaps from which the usual period is taken."""
STEADY_AFTER = 8
"""Number of frames at the usual period after which it is no longer taken for misjudged."""


class FrameFault(StrEnum):
    """What is wrong with a frame."""

    BLACK = "black"
    SATURATED = "saturated"
    TORN = "torn"
    FROZEN = "frozen"
    LATE = "late"


LIKELY = {
    FrameFault.BLACK: "The picture is black: lens covered or light off? ",
    FrameFault.SATURATED: "The picture is white: too much light, or exposed too long? ",
}
"""The cause of a fault that a person can see at the camera."""


class FrameHealth:
    """Judges the frames of one camera in the order in which they arrive."""

    def __init__(self, *, latency_ns: int, live: bool, independent: bool = False) -> None:
        """`independent`: each frame is coded by itself, so pixels of the previous frame come from the decoder."""
        self._latency_ns = latency_ns
        self._live = live
        self._independent = independent
        self._last_end: int | None = None
        self._last_digest: int | None = None
        self._equal = 0
        self._last_ns: int | None = None
        self._periods: deque[int] = deque(maxlen=PERIODS_KEPT)
        self._backlog = 0
        """Number of coming frames that may have waited in a buffer."""
        self._steady = 0
        """Number of frames that came at the usual period."""
        self._stalled = False
        self._learning_again = False
        self.counts: Counter[FrameFault] = Counter()
        self.repeated = False
        """Whether the last frame equals the one before it: nothing new, though not yet a fault."""

    def judge(self, image: NDArray[np.uint8], arrival_ns: int) -> FrameFault | None:
        """The first fault found in an (h, w) or (h, w, 3) uint8 frame, or None."""
        fault = self._look(image)
        # Clock and digest are kept up to date for faulty frames too.
        digest = zlib.crc32(image[::SAMPLE_STEP].tobytes())
        same, self._last_digest = digest == self._last_digest, digest
        self.repeated = self._live and same
        patched = self._is_patched(image, same)
        frozen, late = self._is_frozen(same), self._is_late(arrival_ns)
        if fault is None and patched:
            fault = FrameFault.TORN
        if fault is None and self._live:
            fault = FrameFault.FROZEN if frozen else FrameFault.LATE if late else None
        if fault is not None:
            self.counts[fault] += 1
        return fault

    def summary(self) -> str:
        """Counts by fault, such as `3 black, 1 torn`; empty if there were none."""
        return ", ".join(f"{count} {fault}" for fault, count in sorted(self.counts.items()))

    def describe(self, fault: FrameFault) -> str:
        """The likely cause, where it is known, and how many frames of each kind were skipped."""
        return f"{LIKELY.get(fault, '')}frames skipped: {self.summary()}"

    def _look(self, image: NDArray[np.uint8]) -> FrameFault | None:
        import numpy as np

        sample = image[::SAMPLE_STEP, ::SAMPLE_STEP]
        if np.count_nonzero(sample >= BLACK_BELOW) < LIGHT_SHARE * sample.size:
            return FrameFault.BLACK
        if float(np.mean(sample >= 255)) > SATURATED_SHARE:
            return FrameFault.SATURATED
        band = image[-max(8, round(TORN_BAND_SHARE * image.shape[0])) :]
        if int(band.max()) - int(band.min()) <= 1 and int(band.min()) < 254:  # clipped white is light, not loss
            return FrameFault.TORN
        return None

    def _is_patched(self, image: NDArray[np.uint8], same: bool) -> bool:
        """True if the end of the frame equals that of the last whole frame bit for bit, while the rest differs.

        FFmpeg fills the missing part of a JPEG from the previous picture: half of the photograph would be old.
        """
        if not self._independent:
            return False
        end = image[-END_ROWS:]
        digest, clipped = zlib.crc32(end.tobytes()), int(end.min()) >= 254
        if digest == self._last_end and not clipped and not same:
            return True
        self._last_end = digest
        return False

    def _is_frozen(self, same: bool) -> bool:
        self._equal = self._equal + 1 if same else 0
        return self._equal + 1 >= FROZEN_AFTER

    def _is_late(self, arrival_ns: int) -> bool:
        """True for a frame that had waited in a buffer: its arrival says nothing about its exposure."""
        gap_ns = arrival_ns - self._last_ns if self._last_ns is not None else 0
        self._last_ns = arrival_ns
        if len(self._periods) < PERIODS_LEARNED:
            self._periods.append(gap_ns)
            return self._learning_again
        usual_ns = max(sorted(self._periods)[len(self._periods) // 2], 1)
        stalled = gap_ns > max(3 * usual_ns, self._latency_ns)
        again, self._stalled = stalled and self._stalled, stalled
        if again and self._steady < STEADY_AFTER:
            # A backlog comes in a burst, so two pauses in a row are the period; the gaps of a first burst were not.
            self._periods.clear()
            self._steady, self._learning_again = 0, True
            return True
        if stalled:
            # No more frames can have waited than came in the gap, so a camera with a misjudged period recovers.
            self._backlog = 1 + gap_ns // usual_ns
        if self._backlog == 0:
            self._periods.append(gap_ns)
            self._steady, self._learning_again = self._steady + 1, False
            return False
        if stalled or gap_ns < BURST_SHARE * usual_ns:
            self._backlog -= 1
            if self._backlog == 0:
                self._periods.clear()
            return True
        self._backlog = 0
        return False


REOPEN_AFTER_S = 0.5
LASTING_NS = 1_000_000_000
JOIN_S = 5.0
QUIET_NS = 30_000_000_000
"""Time without a faulty frame after which faulty frames are worth another notice."""


class OpenCvCamera:
    """`Camera` over one source. Each connection has its own grabber, so no frame outlives its connection."""

    def __init__(self, table: CameraTable, clock: Clock, on_notice: Callable[[str], None] = lambda _text: None) -> None:
        self._table = table
        self._clock = clock
        self._on_notice = on_notice
        self._grabber: _Grabber | None = None

    async def connect(self) -> Identity:
        """Start the grabber and wait for its first valid frame. Raises `ConnectionLost`, `DeviceError`, ..."""
        grabber = self._grabber = _Grabber(self._table, self._clock, self._on_notice)
        grabber.thread.start()
        try:
            frame = await self.fresh(Stamp(0))
        except BaseException:
            await self.close()
            raise
        height, width = frame.image.shape[:2]
        locked = "".join(f", {name} {value:g}" for name, value in grabber.settings.items())
        return Identity(DEVICE, f"{self._table.source} {width}x{height}{locked}", "", grabber.simulated)

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

    def __init__(self, table: CameraTable, clock: Clock, on_notice: Callable[[str], None]) -> None:
        self._table = table
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
            if not self._condition.wait_for(lambda: late_enough() or over(), self._table.timeout_s):
                why = f" ({self._trouble})" if self._trouble else ""
                raise DeviceTimeout(
                    DEVICE,
                    "fresh",
                    f"no valid new frame from {self._table.source} in {self._table.timeout_s:g} s{why}",
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
                    source = CaptureSource(self._table)
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
                    raise ConnectionLost(DEVICE, "read", f"{self._table.source} ended")
                lost_ns = self._clock.now_ns()
                self._report("the stream ended and is opened again")
                self._closing.wait(REOPEN_AFTER_S)
        except DeviceError as error:
            self._fail(error)
        except BaseException as error:
            self._fail(DeviceError(DEVICE, "read", f"the grabber failed: {error!r}"))
            raise

    def _read_all(self, source: CaptureSource, opening_ns: int) -> None:
        """Read until the source ends; only valid frames are kept."""
        import cv2

        self.settings, self.simulated = source.settings, source.simulated
        latency_ns = round(self._table.latency_ms * 1e6)
        health = FrameHealth(
            latency_ns=latency_ns,
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
