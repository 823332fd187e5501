"""The limits that every target is checked against before the first motion and again in the driver."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.errors import LimitExceeded
from drivers.geometry import distance, lean
from drivers.samples import Pose

TILT_SLACK_DEG = 1e-6
"""Rounding of a pose that goes through Euler angles must not refuse a tilt that equals the limit."""


@dataclass(frozen=True, slots=True)
class Limits:
    """A box for the tip in the base frame, a tilt cone, and caps on speed and acceleration."""

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]
    z_mm: tuple[float, float]
    """The lower end is the floor: the deepest press allowed below the paper, and never the table."""
    tilt_deg: float
    speed_mm_s: float
    acc_mm_s2: float
    turn_deg_s: float = 45.0
    """Fastest turn of the tool: a short line with a large turn would otherwise be a fling of the wrist."""

    def turn_capped(self, start: Pose, target: Pose, speed_mm_s: float) -> float:
        """The speed along the line at which the tool turns no faster than allowed, in mm/s."""
        travel_mm, turn_deg = distance(start, target)
        if travel_mm < 1.0 or turn_deg < 0.1:
            return speed_mm_s  # in place, ARCS reads mm/s as thousandths of rad/s, which is slow
        return max(min(speed_mm_s, self.turn_deg_s * travel_mm / turn_deg), 0.1)

    def check_start(self, device: str, here: Pose) -> None:
        """Raise `LimitExceeded` where the arm stands outside the box or the cone: no line from there is known."""
        try:
            self.check(device, here, speed_mm_s=self.speed_mm_s, acc_mm_s2=self.acc_mm_s2)
        except LimitExceeded as error:
            raise LimitExceeded(
                device,
                f"the arm stands where {error.field}",
                error.value,
                error.low,
                error.high,
                error.unit,
                remedy="The brush may be down. Jog the arm up, into the box and upright, then start again.",
            ) from None

    def check(self, device: str, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Raise `LimitExceeded` naming the first field that is out of range; NaN is out of every range."""
        try:
            tilt_deg, _ = lean(target)
        except ValueError:  # a quaternion without length has no tilt
            tilt_deg = math.nan
        checks = (
            ("x", target.x_mm, *self.x_mm, "mm"),
            ("y", target.y_mm, *self.y_mm, "mm"),
            ("z", target.z_mm, *self.z_mm, "mm"),
            ("tilt", tilt_deg, 0.0, self.tilt_deg + TILT_SLACK_DEG, "deg"),
            ("speed", speed_mm_s, 0.1, self.speed_mm_s, "mm/s"),
            ("acceleration", acc_mm_s2, 1.0, self.acc_mm_s2, "mm/s2"),
        )
        for field, value, low, high, unit in checks:
            if not low <= value <= high:
                raise LimitExceeded(device, field, value, low, high, unit)
