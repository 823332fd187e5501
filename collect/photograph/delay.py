"""Measures the camera's delay: the arm moves over the sheet and back, and the picture shows it later.

It is not known where on its path the arm comes into the picture, but it enters and leaves at the same point. The time
for which it was seen, compared with its recorded positions, gives that point and so the delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.stats import student_95

Floats = NDArray[np.float64]
GOOD_SHARE, GOOD_S = 0.1, 0.03
"""The delay is known well enough within a tenth of its value, or within 30 ms."""
MOST_GAP_S = 1.0
"""After a longer silence of camera or arm, the time of an event is unknown."""
SLACK_S = 0.05
"""How far a busy computer may shift the times of single poses and frames."""
LEAST_ALIKE, ALIKE_SHARE = 4, 0.75
"""Fewer trips may agree by chance on a busy computer, and so may a smaller share of them."""
EXACT_S = 0.015
"""Half width of the 95 % interval that is good enough for a short delay."""


@dataclass(frozen=True, slots=True)
class FrameChange:
    """How far one frame differs from the view without the arm."""

    arrival_s: float
    changed: float
    """Share of the picture, 0 to 1."""


@dataclass(frozen=True, slots=True)
class ArmPlace:
    """Where the arm was at one time."""

    t_s: float
    way: float
    """0 at its position outside the picture, 1 over the sheet."""


@dataclass(frozen=True, slots=True)
class Look:
    """The delay measured on one trip over the sheet and back."""

    delay_s: float
    resolution_s: float
    """Uncertainty of the delay, as camera and arm report only once per period."""


@dataclass(frozen=True, slots=True)
class CameraDelay:
    """The delay measured on several trips."""

    looks: tuple[Look, ...]

    @property
    def delay_s(self) -> float:
        """Mean time from an event to the arrival of the first frame that shows it, without trips in which something
        stalled: those are farther from the median than the periods of camera and arm explain."""
        return float(self._alike_s.mean())

    @property
    def _alike_s(self) -> Floats:
        """Delays of the trips that agree with the median."""
        delays_s = np.array([look.delay_s for look in self.looks])
        off_s = np.abs(delays_s - np.median(delays_s))
        typical_s = float(np.median([look.resolution_s for look in self.looks]))
        return delays_s[off_s <= max(2.0 * typical_s, GOOD_S, float(off_s.min()))]

    @property
    def exact(self) -> bool:
        """Whether most of the trips agree, and by their spread the mean is known to a tenth of its value (95 %)."""
        alike_s = self._alike_s
        if len(alike_s) < max(LEAST_ALIKE, ALIKE_SHARE * len(self.looks)):
            return False
        reach_s = float(student_95(len(alike_s) - 1) * alike_s.std(ddof=1) / len(alike_s) ** 0.5)
        return reach_s <= max(GOOD_SHARE * self.delay_s, EXACT_S)

    @property
    def spread_s(self) -> float:
        """Difference between the longest and the shortest delay."""
        delays_s = [look.delay_s for look in self.looks]
        return max(delays_s) - min(delays_s)

    @property
    def resolution_s(self) -> float:
        """Uncertainty of the mean delay."""
        return float(np.median([look.resolution_s for look in self.looks])) / len(self.looks) ** 0.5

    @property
    def bound_s(self) -> float:
        """The largest sum of a trip's delay and its uncertainty."""
        return max(look.delay_s + look.resolution_s for look in self.looks)

    @property
    def known(self) -> bool:
        """Whether the trips differ by no more than the camera's period explains, and suffice to average that out."""
        good_s = max(GOOD_SHARE * self.delay_s, GOOD_S)
        typical_s = float(np.median([look.resolution_s for look in self.looks]))
        return self.spread_s <= max(2.0 * typical_s, good_s) and self.resolution_s <= good_s

    def __str__(self) -> str:
        delay_ms, resolution_ms, spread_ms = (1e3 * v for v in (self.delay_s, self.resolution_s, self.spread_s))
        trips = f"{len(self.looks)} trips, which differ by {spread_ms:.0f} ms"
        return f"{delay_ms:.0f} ± {resolution_ms:.0f} ms (from {trips})"


def look(seen: Sequence[FrameChange], placed: Sequence[ArmPlace]) -> Look | None:
    """Return the delay of one trip; None if a silence, or a picture that does not fit the trip, leaves it unknown.

    `seen` begins and ends without the arm; `placed` goes from 0 to 1 and back.
    """
    arrival_s = np.array([one.arrival_s for one in seen])
    changed = np.array([one.changed for one in seen])
    t_s, way = np.array([one.t_s for one in placed]), np.array([one.way for one in placed])
    if len(seen) < 3 or len(placed) < 3 or max(np.diff(arrival_s).max(), np.diff(t_s).max()) > MOST_GAP_S:
        return None
    half = 0.5 * float(changed.max())
    inside = np.flatnonzero(changed >= half)
    first, last = int(inside[0]), int(inside[-1])
    if first == 0 or last == len(seen) - 1 or float(changed.max()) <= 0.0:
        return None
    entered_s, coarse_in = _crossing(arrival_s, changed, first, half)
    left_s, coarse_out = _crossing(arrival_s[::-1], changed[::-1], len(seen) - 1 - last, half)
    turn = int(np.argmax(way))
    points = np.linspace(0.02, 0.98, 97)
    there_s = np.interp(points, np.maximum.accumulate(way[: turn + 1]), t_s[: turn + 1])
    back_s = np.interp(points, np.maximum.accumulate(way[turn:][::-1]), t_s[turn:][::-1])
    # The farther out a point, the shorter the time beyond it: take the point at which that equals the time it was seen.
    misfit_s = np.abs((back_s - there_s) - (left_s - entered_s))
    at = int(np.argmin(misfit_s))
    if float(misfit_s[at]) > coarse_in + coarse_out + SLACK_S:
        return None  # the arm was seen for longer or shorter than it was there: the frames show another trip
    delay_s = 0.5 * float((entered_s - there_s[at]) + (left_s - back_s[at]))
    coarse_s = 0.5 * (coarse_in + coarse_out + _gap(t_s, there_s[at]) + _gap(t_s, back_s[at]))
    return Look(max(delay_s, 0.0), coarse_s)


def _crossing(arrival_s: Floats, changed: Floats, first: int, half: float) -> tuple[float, float]:
    """(when the change passed `half` between frame `first` - 1 and `first`, how uncertain that is), in s."""
    before, after = float(changed[first - 1]), float(changed[first])
    share = (half - before) / (after - before)
    gap_s = abs(float(arrival_s[first] - arrival_s[first - 1]))
    at_s = float(arrival_s[first - 1] + share * (arrival_s[first] - arrival_s[first - 1]))
    # Frames during the change narrow the time down; a jump from none to all leaves the whole gap uncertain.
    return at_s, 0.5 * gap_s * min(1.0, (after - before) / (2.0 * half))


def _gap(t_s: Floats, at_s: float) -> float:
    """Half the time between the two samples around `at_s`."""
    after = min(max(int(np.searchsorted(t_s, at_s)), 1), len(t_s) - 1)
    return 0.5 * float(t_s[after] - t_s[after - 1])
