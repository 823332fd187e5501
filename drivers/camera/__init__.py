"""A camera that is read without pause, so that no frame is older than it looks, and decoded only when somebody looks.

An unread capture hands back frames that are seconds old (its buffer cannot be shortened). A grabber thread reads all
the time and keeps only the newest frame; `fresh` then waits for one that was exposed late enough, decodes it and looks
at it. A source that ends is opened again, with a notice. Frames that are black, saturated, torn, frozen or late
are named and skipped.

The JPEGs of a stream are kept as they come; OpenCV decodes each frame of any other source.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

from brushloop.drivers.camera.source import DEVICE, CameraTable, Capture, Picture, is_repeated
from brushloop.drivers.devices import Frame, Identity, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout
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
BURST_SHARE = 0.5
"""Frames that arrive within less than this share of the usual period are a backlog."""
PERIODS_KEPT = 32
PERIODS_LEARNED = 3
"""Fewest gaps from which the usual period is taken: pauses count too, so a period that was misjudged is soon known."""

Fault = Literal["black", "saturated", "torn", "frozen", "late"]
"""What is wrong with a frame."""
LIKELY: dict[Fault, str] = {
    "black": "The picture is black: lens covered or light off? ",
    "saturated": "The picture is white: too much light, or exposed too long? ",
}
"""The cause of a fault that a person can see at the camera."""


def looked_at(picture: Picture) -> NDArray[np.uint8] | Fault:
    """The picture as (h, w) uint8 gray levels, or the first fault that it shows by itself.

    The colour of ink on paper is not worth three times the disk space.
    """
    import cv2
    import numpy as np
    from PIL import Image  # unlike OpenCV's, its decoder does not write on the terminal

    if isinstance(picture, bytes):
        try:
            with Image.open(io.BytesIO(picture), formats=("JPEG",)) as jpeg:
                jpeg.draft("L", jpeg.size)
                image = np.asarray(jpeg.convert("L"))
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
            return "torn"  # cut off or broken
    else:
        image = picture if picture.ndim == 2 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    sample = image[::SAMPLE_STEP, ::SAMPLE_STEP]
    if np.count_nonzero(sample >= BLACK_BELOW) < LIGHT_SHARE * sample.size:
        return "black"
    if float(np.mean(sample >= 255)) > SATURATED_SHARE:
        return "saturated"
    band = image[-max(8, round(TORN_BAND_SHARE * image.shape[0])) :]
    if int(band.max()) - int(band.min()) <= 1 and int(band.min()) < 254:  # clipped white is light, not loss
        return "torn"
    return image


def is_late(gaps_ns: Sequence[int], latency_ns: int) -> bool:
    """Whether a frame had waited in a buffer, by the gaps between the newest arrivals, of which its own is the last.

    It comes after a stall, or right behind another frame. Its arrival says nothing about its exposure.
    """
    *before_ns, gap_ns = gaps_ns
    if len(before_ns) < PERIODS_LEARNED:
        return False
    usual_ns = sorted(before_ns)[len(before_ns) // 2]
    return gap_ns > max(3 * usual_ns, latency_ns) or gap_ns < BURST_SHARE * usual_ns


POLL_S = 0.005
REOPEN_AFTER_S = 0.5
JOIN_S = 5.0


class OpenCvCamera:
    """The camera of one source; its thread owns the source from open to release."""

    def __init__(self, table: CameraTable, clock: Clock, on_notice: Callable[[str], None] = lambda _text: None) -> None:
        self._table = table
        self._clock = clock
        self._on_notice = on_notice
        self._newest: tuple[Stamp, int, Picture] = Stamp(0, None, -1), -1, b""
        """Stamp, earliest exposure and picture of the newest frame, at first of none; nobody has looked at it yet."""
        self._skipped: Counter[Fault] = Counter()
        """Frames that were passed over, by the thread or when somebody looked at them."""
        self._lost_ns: int | None = None
        """Since when the source has been gone."""
        self._ended: DeviceError | None = None
        self._closing = threading.Event()
        """Ends the thread after its current read."""
        self._thread = threading.Thread(target=self._grab, name="camera grabber", daemon=True)
        self._settings: dict[str, float] = {}
        self._simulated = False

    async def connect(self) -> Identity:
        """Start to grab, and wait for the first valid frame. Raises `ConnectionLost`, `DeviceError`, ..."""
        self._thread.start()
        frame = await self.fresh(Stamp(0))
        height, width = frame.image.shape
        locked = "".join(f", {name} {value:g}" for name, value in self._settings.items())
        return Identity(f"{self._table.source} {width}x{height}{locked}", "", self._simulated)

    async def fresh(self, after: Stamp) -> Frame:
        """The first valid frame exposed after `after.host_ns`, never an older buffered one.

        Raises `DeviceTimeout`, `ConnectionLost`.
        """
        after_ns, until_s = after.host_ns, time.monotonic() + self._table.timeout_s
        skipped_before = self._skipped.copy()
        while True:
            stamp, exposed_after_ns, picture = self._newest
            if self._closing.is_set():
                raise ConnectionLost(DEVICE, "fresh", "closed")
            if exposed_after_ns >= after_ns:
                image = await asyncio.to_thread(looked_at, picture)
                if not isinstance(image, str):
                    return Frame(stamp, exposed_after_ns, image)
                self._skipped[image] += 1
                after_ns = exposed_after_ns + 1
            elif self._ended is not None:
                raise self._ended
            if time.monotonic() >= until_s:
                what = f"no valid new frame from {self._table.source} in {self._table.timeout_s:g} s"
                what += self._why_none(self._skipped.copy() - skipped_before)
                remedy = "Check cable, light and stream; the arm does not move meanwhile."
                raise DeviceTimeout(DEVICE, "fresh", what, remedy=remedy)
            await asyncio.sleep(POLL_S)

    async def close(self) -> None:
        """End the thread and wait for it; a read that hangs is left to it."""
        self._closing.set()
        if self._thread.ident is not None:
            await asyncio.to_thread(self._thread.join, JOIN_S)

    def _why_none(self, skipped: Counter[Fault]) -> str:
        """Why no valid frame came, in brackets; empty if that is not known."""
        if self._lost_ns is not None:
            return " (the stream ended and is opened again)"
        if not skipped:
            return ""
        causes = "".join(LIKELY.get(fault, "") for fault in skipped)
        counts = ", ".join(f"{count} {fault}" for fault, count in sorted(skipped.items()))
        return f" ({causes}frames skipped: {counts})"

    # What follows runs in the thread.

    def _grab(self) -> None:
        try:
            while not self._closing.is_set():
                opening_ns = self._clock.now_ns()
                try:
                    source = Capture(self._table)
                except ConnectionLost:
                    if self._lost_ns is None:
                        raise
                    self._closing.wait(REOPEN_AFTER_S)
                    continue
                with contextlib.closing(source):
                    if self._lost_ns is not None:
                        self._on_notice(f"camera is back after {(self._clock.now_ns() - self._lost_ns) / 1e9:.1f} s")
                        self._lost_ns = None
                    self._read_all(source, opening_ns)
                if self._closing.is_set():
                    return
                self._lost_ns = self._clock.now_ns()
                self._on_notice("camera: the stream ended and is opened again")
                self._closing.wait(REOPEN_AFTER_S)
        except DeviceError as error:
            self._ended = error
        except BaseException as error:
            self._ended = DeviceError(DEVICE, "read", f"the grabber failed: {error!r}")
            raise

    def _read_all(self, source: Capture, opening_ns: int) -> None:
        """Read until the source ends; late and repeated frames are skipped."""
        self._settings, self._simulated = source.settings, source.simulated
        latency_ns = round(self._table.latency_ms * 1e6)
        before, gaps_ns, last_ns = None, deque[int](maxlen=PERIODS_KEPT), opening_ns
        while not self._closing.is_set():
            picture = source.read()
            arrival_ns = self._clock.now_ns()
            if picture is None:
                return
            # The first frame was read to learn the format, and waited until the capture was open.
            exposed_ns = (opening_ns if before is None else arrival_ns) - latency_ns
            if before is not None:
                gaps_ns.append(arrival_ns - last_ns)
            last_ns = arrival_ns
            late, repeated = bool(gaps_ns) and is_late(gaps_ns, latency_ns), is_repeated(picture, before)
            before = picture
            if late or repeated:
                self._skipped["late" if late else "frozen"] += 1
            else:
                self._newest = Stamp(arrival_ns, None, self._newest[0].seq + 1), exposed_ns, picture
