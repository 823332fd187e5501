"""The loopback arm's motion: a queue of straight lines with trapezoidal timing, evaluated when asked."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.geometry import distance, interpolate
from drivers.samples import Pose

STEADY_LAG_S = 0.08
"""The controller reports steady a little after its queue is empty."""
SAME_POSE_MM = 1e-4
SAME_POSE_DEG = 1e-4
ROTATION_AS_LINEAR_MM = 1.0
"""Below this travel, ARCS reads speed and acceleration as rad/s and rad/s2."""


@dataclass(frozen=True, slots=True)
class Ramp:
    """Distance over time: up at `acc`, along at `speed`, down at `acc`; a triangle where the way is short."""

    length: float
    speed: float
    acc: float
    angular: bool = False
    """True where length is in rad, not mm."""

    @property
    def peak(self) -> float:
        """The speed that is really reached."""
        return min(self.speed, math.sqrt(self.length * self.acc))

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        return self.length / self.peak + self.peak / self.acc if self.length > 0 else 0.0

    def at(self, t: float) -> tuple[float, float]:
        """(distance, speed) at time `t`, held at the ends."""
        total, ramp_s, peak = self.duration_s, self.peak / self.acc, self.peak
        if t <= 0.0:
            return 0.0, 0.0
        if t >= total:
            return self.length, 0.0
        if t < ramp_s:
            return 0.5 * self.acc * t * t, self.acc * t
        if t > total - ramp_s:
            left = total - t
            return self.length - 0.5 * self.acc * left * left, self.acc * left
        return 0.5 * peak * ramp_s + peak * (t - ramp_s), peak


@dataclass(frozen=True, slots=True)
class Segment:
    """One accepted line. `stop_s` cuts it: from then on it decelerates instead."""

    ident: int
    start: Pose
    end: Pose
    ramp: Ramp
    begin_s: float
    stop_s: float | None = None
    stop_acc: float = 0.0

    @property
    def end_s(self) -> float:
        """When it is over."""
        if self.stop_s is None:
            return self.begin_s + self.ramp.duration_s
        _, speed = self.ramp.at(self.stop_s - self.begin_s)
        return min(self.stop_s + speed / self.stop_acc, self.begin_s + self.ramp.duration_s)

    @property
    def rest(self) -> Pose:
        """Where it ends: short of `end` if it was stopped."""
        return self.end if self.stop_s is None else self.pose(self.end_s)

    def pose(self, now_s: float) -> Pose:
        """Where the tool is at `now_s`."""
        t = now_s - self.begin_s
        if self.stop_s is not None and now_s > self.stop_s:
            done, speed = self.ramp.at(self.stop_s - self.begin_s)
            dt = min(now_s, self.end_s) - self.stop_s
            travelled = min(done + speed * dt - 0.5 * self.stop_acc * dt * dt, self.ramp.length)
        else:
            travelled, _ = self.ramp.at(t)
        return interpolate(self.start, self.end, travelled / self.ramp.length if self.ramp.length else 1.0)


class MotionQueue:
    """First in, first out. `on_path(start, end)` is told of every stretch once it has been travelled."""

    def __init__(self, home: Pose, on_path: Callable[[Pose, Pose], None], capacity: int = 64) -> None:
        self._rest = home
        self._rest_since_s = -1.0
        self._on_path = on_path
        self._capacity = capacity
        self._queue: deque[Segment] = deque()
        self._next_id = 0

    @property
    def full(self) -> bool:
        """True when another line would be refused."""
        return len(self._queue) >= self._capacity

    def add(self, target: Pose, speed_mm_s: float, acc_mm_s2: float, now_s: float) -> bool:
        """Append a line; False where the target is where the last one ends."""
        self.advance(now_s)
        start = self._queue[-1].rest if self._queue else self._rest
        travel_mm, turn_deg = distance(start, target)
        if travel_mm <= SAME_POSE_MM and turn_deg <= SAME_POSE_DEG:
            return False
        turn_rad = math.radians(turn_deg)
        if travel_mm < ROTATION_AS_LINEAR_MM and turn_rad > 1e-4:
            ramp = Ramp(turn_rad, speed_mm_s / 1e3, acc_mm_s2 / 1e3, angular=True)
        else:
            ramp = Ramp(travel_mm, speed_mm_s, acc_mm_s2)
        begin_s = self._queue[-1].end_s if self._queue else now_s
        self._queue.append(Segment(self._next_id, start, target, ramp, begin_s))
        self._next_id += 1
        return True

    def advance(self, now_s: float) -> None:
        """Retire every segment that is over by `now_s`."""
        while self._queue and self._queue[0].end_s <= now_s:
            segment = self._queue.popleft()
            final = segment.pose(segment.end_s)
            self._rest, self._rest_since_s = final, segment.end_s
            self._on_path(segment.start, final)

    def stop(self, acc_mm_s2: float, acc_rad_s2: float, now_s: float) -> None:
        """Decelerate on the current segment and forget the rest; a second stop changes nothing."""
        self.advance(now_s)
        if not self._queue:
            return
        current = self._queue[0]
        self._queue.clear()
        if current.stop_s is None:
            acc = acc_rad_s2 if current.ramp.angular else acc_mm_s2
            current = replace(current, stop_s=now_s, stop_acc=acc)
        self._queue.append(current)

    def pose(self, now_s: float) -> Pose:
        """Where the tool is."""
        self.advance(now_s)
        return self._queue[0].pose(now_s) if self._queue else self._rest

    def exec_id(self, now_s: float) -> int:
        """Id of the running segment, -1 when the queue is empty."""
        self.advance(now_s)
        return self._queue[0].ident if self._queue else -1

    def steady(self, now_s: float) -> bool:
        """True once the queue has been empty for `STEADY_LAG_S`."""
        self.advance(now_s)
        return not self._queue and now_s - self._rest_since_s >= STEADY_LAG_S
