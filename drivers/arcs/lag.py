"""Measures how late poses arrive: they are stamped on arrival, and a controller or a network may hold them back.

While the arm moves, the driver also asks the controller where it is. The lag is the time by which the path of the poses
that arrived must be shifted so that it agrees with the poses that were asked for.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from brushloop.drivers.clock import Clock
from brushloop.drivers.samples import Pose, PoseSample

QUICK_S = 0.05
"""An answer that took longer, as on a busy computer, does not say well enough when the arm was there."""
MOVED_MM = 0.2
"""The arm moved if it was this far from where it was when it was asked before: at rest, every lag would agree."""
FEWEST, LEAST_MM = 5, 10.0
"""Answers, and the length of the path between them, that it takes to measure the lag."""
GAP_S = 0.1
"""In a longer silence between two poses the path is unknown."""
LONGEST_S, STEP_S = 5.0, 0.01
MISFIT_SHARE = 0.25
"""Largest mean distance between the two paths, as a share of their extent, at which they are the same path."""

Point = tuple[float, float, float, float]
"""Time in s, and the position in mm."""


class LagMeter:
    """The lag of the poses of one arm, over its newest motions."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._arrived: deque[Point] = deque(maxlen=2000)
        self._asked: deque[Point] = deque(maxlen=200)
        self._last_mm = (math.inf,) * 3

    def arrived(self, sample: PoseSample) -> None:
        """Take a pose of the stream."""
        self._arrived.append((sample.stamp.host_ns / 1e9, *sample.pose.position_mm))

    def asked(self, pose: Pose, took_s: float) -> None:
        """Take a pose that was asked for and has just been answered, `took_s` after the question."""
        moved_mm, self._last_mm = math.dist(pose.position_mm, self._last_mm), pose.position_mm
        if MOVED_MM < moved_mm < math.inf and took_s <= QUICK_S:
            self._asked.append((self._clock.now_ns() / 1e9 - 0.5 * took_s, *pose.position_mm))

    def lag_ms(self) -> float | None:
        """The lag; None if the arm has moved too little, or if the two paths cannot be compared."""
        if len(self._arrived) < 2:
            return None
        arrived = np.array(self._arrived)
        t_s, path_mm = arrived[:, 0], arrived[:, 1:]
        asked = np.array([point for point in self._asked if point[0] > t_s[0]]).reshape(-1, 4)
        asked_s, asked_mm = asked[:, 0], asked[:, 1:]
        if len(asked) < FEWEST or np.linalg.norm(np.diff(asked_mm, axis=0), axis=1).sum() < LEAST_MM:
            return None
        lags_s = np.arange(-QUICK_S, LONGEST_S, STEP_S)
        shown_s = lags_s[:, None] + asked_s
        after = np.searchsorted(t_s, shown_s).clip(1, len(t_s) - 1)
        known = (t_s[after] - t_s[after - 1] <= GAP_S) & (shown_s <= t_s[-1])
        shown_mm = np.stack([np.interp(shown_s, t_s, path_mm[:, axis]) for axis in range(3)], axis=-1)
        off_mm = np.linalg.norm(shown_mm - asked_mm, axis=-1)
        enough = known.sum(axis=1) >= max(FEWEST, len(asked) / 2)
        misfit_mm = np.where(enough, (off_mm * known).sum(axis=1) / known.sum(axis=1).clip(1), math.inf)
        best = int(np.argmin(misfit_mm))
        extent_mm = np.linalg.norm(asked_mm - asked_mm.mean(axis=0), axis=1).mean()
        return max(0.0, round(1e3 * float(lags_s[best]), 1)) if misfit_mm[best] <= MISFIT_SHARE * extent_mm else None
