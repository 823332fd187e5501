"""The limits that every target is checked against before the first motion and again in the driver."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.errors import LimitExceeded
from drivers.geometry import lean
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
