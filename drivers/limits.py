"""The limits that every target is checked against before the first motion and again in the driver."""

import math
from typing import Annotated, Self

from pydantic import BaseModel, Field, model_validator

from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import LimitExceeded
from brushloop.drivers.geometry import distance, lean, steepest_deg

TILT_SLACK_DEG = 1e-6
"""Tolerance for rounding in Euler angles: a tilt equal to the limit must not be refused."""
REST_SLACK_MM, REST_SLACK_DEG = 0.1, 0.2
"""An arm that was sent to a limit may rest a little beyond it."""
ALONG_DEG = 1.0
"""Angle from the tool axis up to which a line counts as along it."""
TURN_DEG_S = 45.0
"""Fastest turn of the tool: a short line with a large turn would otherwise whip the wrist round."""
MOST = 1e6
"""Largest number accepted: a length of a kilometre is a typing error."""
Finite = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]


class Limits(BaseModel, frozen=True, extra="forbid"):
    """The table `[robot.limits]` of `rig.toml`: the region that the tip must never leave, in the robot's base frame.

    A box, a cone for the tilt, and caps on speed and acceleration.
    """

    x_mm: tuple[Finite, Finite]
    y_mm: tuple[Finite, Finite]
    z_mm: tuple[Finite, Finite]
    """The lower end is the floor: the deepest press allowed below the paper, and never the table."""
    tilt_deg: Annotated[float, Field(gt=0.0, le=30.0)] = 15.0
    speed_mm_s: Annotated[float, Field(gt=0.0, le=500.0)] = 250.0
    acc_mm_s2: Annotated[float, Field(gt=0.0, le=5000.0)] = 1000.0

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("x_mm", "y_mm", "z_mm"):
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name} = [{low}, {high}]: the first must be less than the second")
        return self

    def turn_capped(self, start: Pose, target: Pose, speed_mm_s: float) -> float:
        """The speed along the line at which the tool turns no faster than allowed, in mm/s."""
        travel_mm, turn_deg = distance(start, target)
        if travel_mm < 1.0 or turn_deg < 0.1:
            return speed_mm_s  # in place, ARCS reads mm/s as thousandths of rad/s, which is slow
        return max(min(speed_mm_s, TURN_DEG_S * travel_mm / turn_deg), 0.1)

    def check_start(self, device: str, here: Pose) -> None:
        """Raise `LimitExceeded` if the arm stands outside the box or the cone: no line from there is known to be safe.

        A start below the floor is allowed: up along the tool axis is a way out.
        """
        for field, value, (low, high), slack, unit in (
            ("x", here.x_mm, self.x_mm, REST_SLACK_MM, "mm"),
            ("y", here.y_mm, self.y_mm, REST_SLACK_MM, "mm"),
            ("z", max(here.z_mm, self.z_mm[0]), self.z_mm, REST_SLACK_MM, "mm"),
            ("tilt", lean(here)[0], (0.0, self.tilt_deg), REST_SLACK_DEG, "deg"),
        ):
            if not low - slack <= value <= high + slack:
                raise _stands_outside(device, field, value, low, high, unit)

    def check_way(self, device: str, start: Pose, target: Pose) -> None:
        """Raise `LimitExceeded` unless the whole line to an already checked target is within the limits.

        A box that contains both ends contains the line; a tilt cone may not. From below the floor only a
        line up along the tool axis is allowed.
        """
        self.check_start(device, start)
        if start.z_mm < self.z_mm[0] - REST_SLACK_MM and not _rises_along_tool(start, target):
            raise _stands_outside(device, "z", start.z_mm, *self.z_mm, "mm")
        steepest = steepest_deg(start, target)
        if steepest > self.tilt_deg + REST_SLACK_DEG:
            raise LimitExceeded(device, "tilt on the way", steepest, 0.0, self.tilt_deg, "deg")

    def check(self, device: str, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Raise `LimitExceeded` naming the first field that is out of range; NaN is out of every range."""
        try:
            tilt_deg, _ = lean(target)
        except ValueError:  # a zero quaternion has no tilt
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


def _stands_outside(device: str, field: str, value: float, low: float, high: float, unit: str) -> LimitExceeded:
    remedy = "The brush may be down. Jog the arm up, into the box and upright, then start again."
    return LimitExceeded(device, f"the arm stands where {field}", value, low, high, unit, remedy=remedy)


def _rises_along_tool(start: Pose, target: Pose) -> bool:
    """Whether the line leads up along the ferrule, without a turn."""
    travel_mm, turn_deg = distance(start, target)
    tilt_deg, heading_deg = lean(start)
    out, up = math.sin(math.radians(tilt_deg)), math.cos(math.radians(tilt_deg))
    ferrule = (out * math.cos(math.radians(heading_deg)), out * math.sin(math.radians(heading_deg)), up)
    way = [b - a for a, b in zip(start.position_mm, target.position_mm, strict=True)]
    along_mm = sum(a * b for a, b in zip(ferrule, way, strict=True))
    return turn_deg < ALONG_DEG and along_mm > 0.0 and along_mm >= travel_mm * math.cos(math.radians(ALONG_DEG))
