"""Reads an arm before there is a `rig.toml`: asks only what sets nothing, powers nothing and moves nothing."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, Controller, six
from brushloop.drivers.arcs.robot import AUBOPE_PORT
from brushloop.drivers.arcs.wire import DEVICE, Framing, RpcConnection, numbers, open_arcs
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, ProtocolViolation, RpcError
from brushloop.drivers.geometry import distance, from_wire

FRAMINGS: tuple[Framing, ...] = ("sof", "bare")
STILL_MM, STILL_DEG = 0.02, 0.01
"""An arm that is held still by hand moves by less than this between two readings."""
STILL_S, PATIENCE_S = 0.1, 20.0
MOST_CHARACTERS = 100
"""Of a name that a cabinet reports; the notebook has no room for more than a few of these."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where a controller listens."""

    host: str
    port: int = 30004

    @classmethod
    def of(cls, text: str) -> Address:
        """From `HOST` or `HOST:PORT`. Raises ValueError."""
        host, _, port = text.strip().partition(":")
        if not host or any(c.isspace() for c in host):
            raise ValueError(f"{text!r} is not an address like 192.0.2.7 or 192.0.2.7:30004")
        port = port or "30004"
        if not (port.isdecimal() and len(port) <= 5 and 1 <= int(port) <= 65535):
            raise ValueError(f"port {port!r} is not a number from 1 to 65535")
        return cls(host, int(port))

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


@dataclass(frozen=True, slots=True)
class Cabinet:
    """What a cabinet reports about itself and its arm."""

    framing: Framing
    model: str
    box: str
    firmware: str
    robot_mode: str
    safety_mode: str
    operational_mode: str
    tcp_mm_deg: tuple[float, ...]
    """Flange to tool as set on the pendant: x, y, z in mm, rx, ry, rz in deg."""
    payload_kg: float
    payload_cog_mm: tuple[float, ...]
    collision_level: int

    @property
    def simulated(self) -> bool:
        """Whether it identifies itself as the loopback controller."""
        return self.box == LOOPBACK_CONTROL_BOX


class ArmReader:
    """One connection on which nothing but what is below is asked. Every method may raise `DeviceError`."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    async def _ask(self, method: str) -> Any:
        if self._controller.connection.lost:
            await self._controller.connection.reopen()
        return await self._controller.ask(method)

    async def _name(self, method: str) -> str:
        return str(await self._ask(method))[:MOST_CHARACTERS]

    async def tool(self) -> tuple[float, ...]:
        """Flange to tool as the cabinet has it: x, y, z in m, rx, ry, rz in rad."""
        return tuple(six("getTcpOffset", await self._ask("RobotConfig.getTcpOffset")))

    async def flange(self) -> Pose:
        """Wait until the arm is held still, and return the pose of the flange in the base frame.

        From the cabinet's tool pose, with its tool taken off again: whatever is set there does not matter. Raises
        `DeviceTimeout` if the arm keeps moving.
        """
        before = await self.flange_now()
        try:
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    await asyncio.sleep(STILL_S)
                    here = await self.flange_now()
                    moved_mm, turned_deg = distance(before, here)
                    if moved_mm < STILL_MM and turned_deg < STILL_DEG:
                        return here
                    before = here
        except TimeoutError:
            raise DeviceTimeout(
                DEVICE, "getTcpPose", f"the arm did not rest for {PATIENCE_S:g} s", remedy="Hold it still."
            ) from None

    async def flange_now(self) -> Pose:
        """Pose of the flange in the base frame, whether or not the arm rests."""
        tool = await self.tool()
        at = from_wire(six("getTcpPose", await self._ask("RobotState.getTcpPose")))
        turn = Rotation.from_quat(at.quaternion) * Rotation.from_euler("ZYX", tool[5:2:-1]).inv()
        x, y, z = np.array(at.position_mm) - turn.apply(1e3 * np.array(tool[:3]))
        qx, qy, qz, qw = (float(v) for v in turn.as_quat())
        return Pose(float(x), float(y), float(z), qx, qy, qz, qw)

    async def cabinet(self, framing: Framing) -> Cabinet:
        """Everything that the cabinet reports about itself."""
        call = self._controller.connection.call
        firmware = f"interface {await call('SystemInfo.getInterfaceVersionCode')}"
        with contextlib.suppress(RpcError):
            firmware += f", {await call('SystemInfo.getControlSoftwareFullVersion')}"
        tool, level = await self.tool(), await self._ask("RobotConfig.getCollisionLevel")
        if type(level) is not int:
            raise ProtocolViolation(DEVICE, "getCollisionLevel", f"expected a whole number, got {level!r}")
        payload = await self._ask("RobotConfig.getPayload")
        try:
            mass_kg, cog_m, *_ = payload
            [payload_kg], cog_mm = numbers([mass_kg], 1), tuple(1e3 * v for v in numbers(cog_m, 3))
        except (TypeError, ValueError):
            raise ProtocolViolation(DEVICE, "getPayload", f"expected mass and centre, got {payload!r}") from None
        return Cabinet(
            framing,
            await self._name("RobotConfig.getRobotType"),
            await self._name("RobotConfig.getControlBoxType"),
            firmware[:MOST_CHARACTERS],
            await self._name("RobotState.getRobotModeType"),
            await self._name("RobotState.getSafetyModeType"),
            await self._name("RobotManage.getOperationalMode"),
            (*(1e3 * v for v in tool[:3]), *(math.degrees(v) for v in tool[3:])),
            payload_kg,
            cog_mm,
            level,
        )


def tip_of(flange: Pose, offset_mm: Sequence[float]) -> tuple[float, float, float]:
    """Where the tip is while the flange is there, in the base frame."""
    x, y, z = np.array(flange.position_mm) + Rotation.from_quat(flange.quaternion).apply(offset_mm)
    return float(x), float(y), float(z)


@contextlib.asynccontextmanager
async def reading(address: Address, framing: Framing) -> AsyncGenerator[ArmReader]:
    """Connect to a controller, yield a reader, and disconnect. Raises `WrongGeneration` and other `DeviceError`s."""
    connection = RpcConnection(address.host, address.port, framing=framing)
    controller = Controller(connection)
    try:
        await open_arcs(connection, AUBOPE_PORT)
        await connection.login()
        [controller.robot, *_] = await controller.robot_names()
        yield ArmReader(controller)
    finally:
        await connection.close()


async def find_framing(address: Address) -> Framing:
    """The framing that the controller answers. Raises `WrongGeneration`, or the first framing's `DeviceError`."""
    first: DeviceError | None = None
    for framing in FRAMINGS:
        try:
            async with reading(address, framing):
                return framing
        except ConnectionLost:
            raise
        except (DeviceTimeout, ProtocolViolation) as error:
            first = first or error
    assert first is not None
    raise first


async def answers(host: str, port: int, within_s: float = 3.0) -> bool:
    """Whether anything listens there."""
    try:
        async with asyncio.timeout(within_s):
            _, writer = await asyncio.open_connection(host, port)
    except (OSError, TimeoutError):
        return False
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return True
