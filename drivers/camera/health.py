"""Decide whether a frame is valid: black, saturated, torn, frozen and late frames are named and skipped."""

from __future__ import annotations

import zlib
from collections import Counter, deque
from enum import StrEnum
from typing import TYPE_CHECKING

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
BURST_SHARE = 0.5
"""Frames that arrive within less than this share of the usual period are a backlog."""
PERIODS_KEPT = 31
PERIODS_LEARNED = 3
"""Number of gaps from which the usual period is taken."""
STEADY_AFTER = 8
"""Number of frames at the usual period after which it is no longer taken for misjudged."""


class Fault(StrEnum):
    """What is wrong with a frame."""

    BLACK = "black"
    SATURATED = "saturated"
    TORN = "torn"
    FROZEN = "frozen"
    LATE = "late"


LIKELY = {
    Fault.BLACK: "The picture is black: lens covered or light off? ",
    Fault.SATURATED: "The picture is white: too much light, or exposed too long? ",
}
"""The cause of a fault that a person can see at the camera."""


class FrameHealth:
    """Judges the frames of one camera in the order in which they arrive."""

    def __init__(self, *, latency_ns: int, frozen_after: int, live: bool, independent: bool = False) -> None:
        """`independent`: each frame is coded by itself, so pixels of the previous frame come from the decoder."""
        self._latency_ns = latency_ns
        self._frozen_after = frozen_after
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
        self.counts: Counter[Fault] = Counter()
        self.repeated = False
        """Whether the last frame equals the one before it: nothing new, though not yet a fault."""

    def judge(self, image: NDArray[np.uint8], arrival_ns: int) -> Fault | None:
        """The first fault found in an (h, w) or (h, w, 3) uint8 frame, or None."""
        fault = self._look(image)
        # Clock and digest are kept up to date for faulty frames too.
        digest = zlib.crc32(image[::SAMPLE_STEP].tobytes())
        same, self._last_digest = digest == self._last_digest, digest
        self.repeated = self._live and same
        patched = self._is_patched(image, same)
        frozen, late = self._is_frozen(same), self._is_late(arrival_ns)
        if fault is None and patched:
            fault = Fault.TORN
        if fault is None and self._live:
            fault = Fault.FROZEN if frozen else Fault.LATE if late else None
        if fault is not None:
            self.counts[fault] += 1
        return fault

    def summary(self) -> str:
        """Counts by fault, such as `3 black, 1 torn`; empty if there were none."""
        return ", ".join(f"{count} {fault}" for fault, count in sorted(self.counts.items()))

    def describe(self, fault: Fault) -> str:
        """The likely cause, where it is known, and how many frames of each kind were skipped."""
        return f"{LIKELY.get(fault, '')}frames skipped: {self.summary()}"

    def _look(self, image: NDArray[np.uint8]) -> Fault | None:
        import numpy as np

        sample = image[::SAMPLE_STEP, ::SAMPLE_STEP]
        if np.count_nonzero(sample >= BLACK_BELOW) < LIGHT_SHARE * sample.size:
            return Fault.BLACK
        if float(np.mean(sample >= 255)) > SATURATED_SHARE:
            return Fault.SATURATED
        band = image[-max(8, round(TORN_BAND_SHARE * image.shape[0])) :]
        if int(band.max()) - int(band.min()) <= 1 and int(band.min()) < 254:  # clipped white is light, not loss
            return Fault.TORN
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
        return self._equal + 1 >= self._frozen_after

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
