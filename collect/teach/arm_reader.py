"""Reads an arm before there is a `rig.toml`: a list of questions that set nothing, power nothing and move nothing."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, six
from brushloop.drivers.arcs.robot import AUBOPE_PORT
from brushloop.drivers.arcs.wire import DEVICE, Framing, RpcConnection, numbers, open_arcs
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, ProtocolViolation, RpcError
from brushloop.drivers.geometry import distance, from_wire

READ_ONLY = frozenset(
    {
        "getRobotNames",
        "SystemInfo.getInterfaceVersionCode",
        "SystemInfo.getControlSoftwareFullVersion",
        "RobotConfig.getRobotType",
        "RobotConfig.getRobotSubType",
        "RobotConfig.getControlBoxType",
        "RobotConfig.getTcpOffset",
        "RobotConfig.getPayload",
        "RobotConfig.getCollisionLevel",
        "RobotManage.getOperationalMode",
        "RobotState.getRobotModeType",
        "RobotState.getSafetyModeType",
        "RobotState.getTcpPose",
        "RobotState.getJointPositions",
        "RobotState.isSteady",
        "RobotAlgorithm.inverseKinematics",
    }
)
"""All methods that are called before there is a `rig.toml`."""
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
    """One connection on which only `READ_ONLY` is asked."""

    def __init__(self, connection: RpcConnection, robot: str) -> None:
        self._connection = connection
        self._robot = robot

    async def ask(self, method: str, **params: object) -> Any:
        """The unchecked answer. Raises ValueError for a method that is not in the list, and `DeviceError`."""
        if method not in READ_ONLY:
            raise ValueError(f"{method} is not one of the questions that change nothing")
        if self._connection.lost:
            await self._connection.reopen()
        return await self._connection.call(f"{self._robot}.{method}", params)

    async def tool(self) -> tuple[float, ...]:
        """Flange to tool as the cabinet has it: x, y, z in m, rx, ry, rz in rad."""
        return tuple(six("getTcpOffset", await self.ask("RobotConfig.getTcpOffset")))

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
        """Pose of the flange in the base frame, whether or not the arm rests. Raises `DeviceError`."""
        tool = await self.tool()
        at = from_wire(six("getTcpPose", await self.ask("RobotState.getTcpPose")))
        turn = Rotation.from_quat(at.quaternion) * Rotation.from_euler("ZYX", tool[5:2:-1]).inv()
        x, y, z = np.array(at.position_mm) - turn.apply(1e3 * np.array(tool[:3]))
        qx, qy, qz, qw = (float(v) for v in turn.as_quat())
        return Pose(float(x), float(y), float(z), qx, qy, qz, qw)

    async def cabinet(self, framing: Framing) -> Cabinet:
        """Everything that the cabinet reports about itself. Raises `DeviceError`."""
        version = await self._connection.call("SystemInfo.getInterfaceVersionCode")
        tool, level = await self.tool(), await self.ask("RobotConfig.getCollisionLevel")
        if type(level) is not int:
            raise ProtocolViolation(DEVICE, "getCollisionLevel", f"expected a whole number, got {level!r}")
        payload = await self.ask("RobotConfig.getPayload")
        try:
            mass_kg, cog_m, *_ = payload
            [payload_kg], cog_mm = numbers([mass_kg], 1), tuple(1e3 * v for v in numbers(cog_m, 3))
        except (TypeError, ValueError):
            raise ProtocolViolation(DEVICE, "getPayload", f"expected mass and centre, got {payload!r}") from None
        return Cabinet(
            framing,
            _name(await self.ask("RobotConfig.getRobotType")),
            _name(await self.ask("RobotConfig.getControlBoxType")),
            _name(await self._firmware(version)),
            _name(await self.ask("RobotState.getRobotModeType")),
            _name(await self.ask("RobotState.getSafetyModeType")),
            _name(await self.ask("RobotManage.getOperationalMode")),
            (*(1e3 * v for v in tool[:3]), *(math.degrees(v) for v in tool[3:])),
            payload_kg,
            cog_mm,
            level,
        )

    async def _firmware(self, version: object) -> str:
        with contextlib.suppress(RpcError):
            return f"interface {version}, {await self._connection.call('SystemInfo.getControlSoftwareFullVersion')}"
        return f"interface {version}"


def _name(answer: object) -> str:
    return str(answer)[:MOST_CHARACTERS]


@contextlib.asynccontextmanager
async def reading(address: Address, framing: Framing) -> AsyncGenerator[ArmReader]:
    """Connect to a controller, yield a reader, and disconnect. Raises `WrongGeneration` and other `DeviceError`s."""
    connection = RpcConnection(address.host, address.port, framing=framing)
    try:
        await open_arcs(connection, AUBOPE_PORT)
        await connection.login()
        names = await connection.call("getRobotNames")
        if not isinstance(names, list) or not names:
            raise ProtocolViolation(DEVICE, "getRobotNames", f"expected a list of names, got {names!r}")
        yield ArmReader(connection, str(names[0]))  # pyright: ignore[reportUnknownArgumentType]
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
