"""What each kind of device must be able to do, and what the devices of a rig take and give.

A sample is frozen and has the time at which it was taken and its place in the sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

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
    """A straight line to `target`, from rest, that takes `least_s` or longer."""

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

    model: str
    firmware: str
    simulated: bool
    """True if the device itself says that it is the loopback rig; never from configuration."""


class Device(Protocol):
    """What every device of a rig can do."""

    async def connect(self) -> Identity:
        """Open the connections, once, and learn who answers; moves and powers nothing.

        Raises `DeviceError`. After that too, `close` has to be called.
        """
        ...

    async def close(self) -> None:
        """Stop what is under way, and close the connections."""
        ...


class Robot(Device, Protocol):
    """An arm with a brush. All poses are of the brush tip, in the base frame; `AuboArcs` says what each call raises."""

    async def enable(self) -> None:
        """Power the arm and release its brakes; moves nothing."""
        ...

    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float) -> None:
        """Move the tip through all poses without halting, corners rounded within 1 mm; returns when it has settled."""
        ...

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        """Have the controller carry out all lines, even if this program dies meanwhile; returns the poses seen."""
        ...

    async def stop(self) -> None:
        """Stop now. Idempotent, from any state, never queued behind a slow call. Not an emergency stop."""
        ...

    def latest(self) -> PoseSample:
        """The newest pose; never blocks. Raises `Stale` when it is too old to act on."""
        ...

    async def where(self) -> Pose:
        """Ask the controller for the pose."""
        ...

    def pose_lag_ms(self) -> float | None:
        """How late poses arrived during the last motions; None if that is not known."""
        ...

    async def confirm(self) -> None:
        """Raise a `MotionError` if the arm is not as it was left; sets nothing."""
        ...

    async def take_up(self) -> Pose:
        """Accept the place where the arm rests as the start of the next move."""
        ...

    def listen(self, on_sample: Callable[[PoseSample], None] | None) -> None:
        """Hand every pose sample to `on_sample`, in the event loop; None ends it."""
        ...


class Camera(Device, Protocol):
    """A camera that looks at the sheet."""

    async def fresh(self, after: Stamp) -> Frame:
        """The first frame exposed after `after`, never an older buffered one. Raises `DeviceTimeout`."""
        ...


class ForceSensor(Device, Protocol):
    """A force sensor between flange and brush; optional in a rig."""

    def latest(self) -> ForceSample:
        """The newest sample; never blocks. Raises `Stale`."""
        ...

    def listen(self, on_sample: Callable[[ForceSample], None] | None) -> None:
        """Hand every sample to `on_sample`, in the event loop; None ends it."""
        ...

    async def bias(self, seconds: float) -> None:
        """Average for `seconds` with nothing touching, and subtract that from now on."""
        ...
