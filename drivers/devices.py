"""What the devices of a rig take and give: poses, lines, samples, and who answered.

A sample is frozen and has the time at which it was taken and its place in the sequence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Stamp:
    """When a sample was taken: `host_ns` when the host received it, `device_ns` by the device's clock if it has one."""

    host_ns: int
    device_ns: int | None = None
    seq: int = 0


@dataclass(frozen=True, slots=True)
class Pose:
    """A tool pose in the robot's base frame: position in mm, orientation as a unit quaternion (x, y, z, w)."""

    x_mm: float
    y_mm: float
    z_mm: float
    qx: float
    qy: float
    qz: float
    qw: float

    @property
    def position_mm(self) -> tuple[float, float, float]:
        """(x, y, z) in mm."""
        return (self.x_mm, self.y_mm, self.z_mm)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """(x, y, z, w), unit length."""
        return (self.qx, self.qy, self.qz, self.qw)


@dataclass(frozen=True, slots=True)
class QueuedLine:
    """A straight line to `target`, from rest to rest, that takes `least_s` or longer."""

    target: Pose
    speed_mm_s: float
    least_s: float = 0.0


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A pose that the robot reported."""

    stamp: Stamp
    pose: Pose
    joints_rad: tuple[float, ...] | None = None
    """Joint positions at the same moment; None if they do not come with the pose."""


@dataclass(frozen=True, slots=True)
class Frame:
    """An image of the camera in (h, w) uint8 gray levels.

    `stamp.host_ns` is the arrival; `exposed_after_ns` is the earliest time at which it can have been exposed.
    """

    stamp: Stamp
    exposed_after_ns: int
    image: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ForceSample:
    """Force in N and torque in Nm in the sensor's frame, less the bias; `stamp.device_ns` is the CAN adapter's time."""

    stamp: Stamp
    force_n: tuple[float, float, float]
    torque_nm: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Identity:
    """The device that answered: in the header of every recording, so that each number can be traced to its source."""

    device: str
    model: str
    firmware: str
    simulated: bool
    """True if the device itself says that it is the loopback rig, or shows a recording; never from configuration."""


@dataclass(frozen=True, slots=True)
class Well:
    """The well before a dip."""

    level: float | None
    """0 to 1; None where the device has no gauge."""
    dosed_ml: float = 0.0
    """What the device has given since it was connected, by a replenishing that failed half way too."""
