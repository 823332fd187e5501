"""The devices of a rig, made from its configuration, connected observers first and closed in reverse."""

from __future__ import annotations

import contextlib
import hashlib
import socket
from collections.abc import AsyncGenerator, Callable, Generator, Mapping
from dataclasses import dataclass, field

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.camera import OpenCvCamera
from brushloop.drivers.devices import Camera, Device, ForceSensor, Identity, Robot
from brushloop.drivers.force.sri_m8123 import SriM8123
from brushloop.drivers.host import Claimed, Clock, claimed
from brushloop.drivers.ink.port import InkDevice
from brushloop.drivers.limits import Limits


@dataclass(frozen=True, slots=True)
class Rig:
    """Connected devices and their identities."""

    config: RigConfig
    clock: Clock
    robot: Robot
    camera: Camera
    force: ForceSensor | None = None
    ink: InkDevice | None = None
    identities: Mapping[str, Identity] = field(default_factory=dict[str, Identity])
    """By the names of the devices above."""

    @property
    def simulated(self) -> bool:
        """Whether any device belongs to the loopback rig."""
        return any(identity.simulated for identity in self.identities.values())


def limits_of(config: RigConfig) -> Limits:
    """The limits of `rig.toml`; the floor is never lower than the deepest press that the brush bears."""
    floor_mm, ceiling_mm = config.robot.limits.z_mm
    floor_mm = max(floor_mm, config.paper.touch_z_mm - config.brush.max_depth_mm)
    return config.robot.limits.model_copy(update={"z_mm": (floor_mm, ceiling_mm)})


def make_robot(config: RigConfig, clock: Clock, on_notice: Callable[[str], None]) -> AuboArcs:
    """The arm's driver, not yet connected."""
    return AuboArcs(config.robot, limits_of(config), clock, on_notice)


@contextlib.contextmanager
def sole_driver(host: str, port: int) -> Generator[None]:
    """Reserve the arm at this address against other processes of this machine, of any user. Raises `ConfigError`."""
    with contextlib.suppress(OSError):
        host = socket.gethostbyname(host)  # two names of one arm are one arm
    address = f"{host}:{port}"
    try:
        with claimed(f"brushloop-arm-{hashlib.sha256(address.encode()).hexdigest()[:16]}"):
            yield
    except Claimed as who:
        raise ConfigError("rig.toml", "robot", f"another brushloop is driving the arm at {address}: {who}") from None


@contextlib.asynccontextmanager
async def identified(device: Device) -> AsyncGenerator[Identity]:
    """Who a device is, which is connected within the block, and closed in any case. Raises `DeviceError`."""
    try:
        yield await device.connect()
    finally:
        await device.close()


@contextlib.asynccontextmanager
async def connected(config: RigConfig, clock: Clock, on_notice: Callable[[str], None]) -> AsyncGenerator[Rig]:
    """Connect camera, force sensor, ink device, then the robot; on the way out always stop the arm first.

    `on_notice` gets what a device reports without being asked, from any thread. Raises `ConfigError` if another
    brushloop on this machine drives the arm: closing ours would stop its motion.
    """
    camera, robot = OpenCvCamera(config.camera, clock, on_notice), make_robot(config, clock, on_notice)
    force = None if config.force is None else SriM8123(config.force, clock)
    ink = None if config.ink.device is None else config.ink.device.device(clock)
    async with contextlib.AsyncExitStack() as stack:
        stack.enter_context(sole_driver(config.robot.host, config.robot.port))
        devices = {"camera": camera, "force": force, "ink": ink, "robot": robot}
        identities = {
            name: await stack.enter_async_context(identified(device))
            for name, device in devices.items()
            if device is not None
        }
        yield Rig(config, clock, robot, camera, force, ink, identities)
