"""Distance over time along a path: speeds up, goes along, slows down."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Ramp:
    """From `v_in` at `acc` to `speed`, along, at `acc` to `v_out`; `speed` is not reached where the way is short.

    Lengths are in mm, or in rad where `angular`; time is in s. `v_in` and `v_out` must be within reach of each other.
    """

    length: float
    speed: float
    acc: float
    angular: bool = False
    v_in: float = 0.0
    v_out: float = 0.0

    @property
    def peak(self) -> float:
        """The speed between the two slopes."""
        if self.v_in >= self.speed:
            return max(self.speed, self.v_out)
        if not self.length:
            return self.v_in
        highest = math.sqrt(self.acc * self.length + 0.5 * (self.v_in * self.v_in + self.v_out * self.v_out))
        return max(min(self.speed, highest), self.v_in, self.v_out)

    @property
    def duration_s(self) -> float:
        """Time for the whole length."""
        return sum(self._times())

    def at(self, t: float) -> tuple[float, float]:
        """(distance, speed) at time `t`, held at the ends."""
        if t <= 0.0:
            return 0.0, self.v_in
        up_s, along_s, down_s = self._times()
        if t >= up_s + along_s + down_s:
            return self.length, self.v_out
        peak = self.peak
        if t < up_s:
            slope = math.copysign(self.acc, peak - self.v_in)
            return self.v_in * t + 0.5 * slope * t * t, self.v_in + slope * t
        if t >= up_s + along_s:
            left = up_s + along_s + down_s - t
            return self.length - self.v_out * left - 0.5 * self.acc * left * left, self.v_out + self.acc * left
        return 0.5 * (self.v_in + peak) * up_s + peak * (t - up_s), peak

    def _times(self) -> tuple[float, float, float]:
        if not self.length:
            return 0.0, 0.0, 0.0
        peak = self.peak
        up_s, down_s = abs(peak - self.v_in) / self.acc, (peak - self.v_out) / self.acc
        along = self.length - 0.5 * (self.v_in + peak) * up_s - 0.5 * (self.v_out + peak) * down_s
        return up_s, max(along, 0.0) / peak, down_s


def paced(length: float, speed: float, acc: float, duration_s: float, rests: int) -> float:
    """The speed at which a way of `length` takes `duration_s`, and never more than `speed`.

    `rests` counts the ends at which it is at rest. T(v) = length / v + rests v / (2 acc), solved for v.
    """
    fastest = min(speed, math.sqrt(2.0 * acc * length / rests)) if rests else speed
    if not length or duration_s <= length / fastest + 0.5 * rests * fastest / acc:
        return speed
    if not rests:
        return length / duration_s
    lead = acc * duration_s
    return (lead - math.sqrt(max(lead * lead - 2.0 * rests * acc * length, 0.0))) / rests
