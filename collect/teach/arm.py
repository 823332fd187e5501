"""Step 1: find the arm. Its address is asked for; all else is read: nothing is set, powered or moved."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.collect.errors import CannotTeach
from brushloop.collect.rig.doctor import Finding
from brushloop.collect.rig.report import Scrubber, numbers_only, transcript, write_archive
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.store import Notebook
from brushloop.drivers.arcs.controller import LOOPBACK_CONTROL_BOX, MOVING_ALLOWED, Controller, six
from brushloop.drivers.arcs.robot import AUBOPE_PORT
from brushloop.drivers.arcs.wire import DEVICE, Framing, RpcConnection, numbers, open_arcs
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, ProtocolViolation, RpcError
from brushloop.drivers.geometry import distance, from_wire

RTDE_PORT = 30010
NAMES = {
    "robot.host": "<host>",
    "aside.address": "<host>",
    "camera.source": "<camera>",
    "aside.sources": "<camera>",
    "force.host": "<host>",
    "aside.bus": "<host>",
    "ink.device.port": "<port>",
}
"""Values that identify the lab, and the placeholder for each."""
LONGEST_TOOL_MM, SHORTEST_TOOL_MM = 600.0, 10.0
"""Plausible distances from the flange to the tip of a brush."""
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


@contextlib.asynccontextmanager
async def taught_arm(notebook: Notebook) -> AsyncGenerator[ArmReader]:
    """The arm that was taught, for reading only."""
    address = Address(str(notebook.get("robot.host")), int(notebook.number("robot.port")))
    async with reading(address, notebook.framing) as reader:
        yield reader


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


class ArmStep(Step):
    """Address, ports, framing, model, firmware, safety state, and what the cabinet says of tool and payload."""

    name = "arm"
    title = "Find the arm"
    minutes = 3
    needs = ()

    async def teach(self, day: Day) -> None:
        """Ask for the address and read everything else. Raises `CannotTeach`, `DeviceError`."""
        address = await self._address(day)
        await day.working(f"asking {address} who it is")
        framing = await find_framing(address)
        async with reading(address, framing) as reader:
            cabinet = await reader.cabinet(framing)
        await day.say(
            f"{address} answers in the {framing} framing: {cabinet.model} ({cabinet.box}), {cabinet.firmware}",
            f"robot mode {cabinet.robot_mode}, safety {cabinet.safety_mode}, mode switch {cabinet.operational_mode}",
            f"tool set on the pendant: {_listed(cabinet.tcp_mm_deg[:3])} mm, turned by "
            f"{_listed(cabinet.tcp_mm_deg[3:])} deg; payload {cabinet.payload_kg:g} kg; "
            f"collision level {cabinet.collision_level}",
        )
        if doubt := doubtful_tool(cabinet):
            await day.say(doubt, tone="warning")
        if cabinet.safety_mode not in MOVING_ALLOWED:
            await day.say(
                f"The safety mode is {cabinet.safety_mode}: the arm cannot be guided by hand until it is released.",
                "Look at the pendant; this program clears nothing.",
                tone="warning",
            )
        rtde = RTDE_PORT
        if address.port != Address("").port:
            question = f"Port that sends poses ({RTDE_PORT} on a cabinet; press Enter unless yours differs)"
            text = await day.text(question, str(RTDE_PORT))
            rtde = int(text) if text.isdecimal() and 0 < int(text) < 65536 else RTDE_PORT
        pushed = await answers(address.host, rtde)
        with day.together():
            self._keep(day, address, cabinet, rtde if pushed else None)

    async def _address(self, day: Day) -> Address:
        question = "Address of the cabinet (pendant: Settings, Network), as 192.0.2.7 or 192.0.2.7:30004"
        try:
            address = Address.of(await day.text(question, str(day.notebook.get("aside.address") or "")))
        except ValueError as error:
            raise CannotTeach(f"{error}.", "Type the address that the pendant shows.") from None
        day.keep("arm", "aside.address", str(address), "typed")
        there = await answers(address.host, address.port)
        if there == (address.port == AUBOPE_PORT) and await answers(address.host, AUBOPE_PORT):
            raise CannotTeach(
                f"{address.host} answers on port {AUBOPE_PORT}, where the older software AUBOPE (V4) listens, and not "
                "where ARCS does:",
                "it is not supported. Ask the maker for the upgrade to ARCS.",
            )
        if not there:
            raise CannotTeach(
                f"nothing answers at {address}.",
                "Check the address on the pendant, the cable, and that this computer is in the same network; then try "
                "again.",
            )
        return address

    def _keep(self, day: Day, address: Address, cabinet: Cabinet, rtde: int | None) -> None:
        as_set = "as set on the pendant"
        day.keep("arm", "robot.kind", "aubo-arcs", f"{cabinet.model} ({cabinet.box}) answered, {cabinet.firmware}")
        day.keep("arm", "robot.host", address.host, "typed, and answered")
        day.keep("arm", "robot.port", address.port, "answered")
        day.keep("arm", "robot.framing", cabinet.framing, "the first that the controller answered")
        if rtde is not None:
            day.keep("arm", "robot.rtde_port", rtde, "answered, and sends poses")
        day.keep("arm", "robot.payload_kg", cabinet.payload_kg, as_set, "kg", known="not weighed")
        day.keep("arm", "robot.payload_cog_mm", list(cabinet.payload_cog_mm), as_set, "mm", known="not measured")
        if cabinet.collision_level:
            day.keep("arm", "robot.collision_level", cabinet.collision_level, as_set)
        day.keep("arm", "aside.pendant_tcp_mm", list(cabinet.tcp_mm_deg[:3]), as_set)
        day.keep("arm", "aside.simulated", cabinet.box == LOOPBACK_CONTROL_BOX, "as the controller reports")

    def summary(self, notebook: Notebook) -> str:
        """The address."""
        return f"{notebook.get('robot.host')}:{notebook.get('robot.port')}"


def doubtful_tool(cabinet: Cabinet) -> str:
    """What is wrong with the tool set on the pendant, and what it means; empty if it is plausible."""
    length_mm = math.hypot(*cabinet.tcp_mm_deg[:3])
    if length_mm > LONGEST_TOOL_MM and SHORTEST_TOOL_MM <= length_mm / 1e3 <= LONGEST_TOOL_MM:
        wrong, meant_mm = "millimetres were typed where metres are taken", length_mm / 1e3
    elif 0.0 < length_mm < 1.0:
        wrong, meant_mm = "metres were typed where millimetres are taken", 1e3 * length_mm
    elif length_mm > LONGEST_TOOL_MM:
        return f"The pendant's tool is {length_mm:.0f} mm long: no brush is. It is measured in the third step"
    else:
        return ""
    return (
        f"The pendant's tool is {length_mm:.3g} mm long: {wrong}, and {meant_mm:.0f} mm are meant. It is measured in "
        "the third step and replaced"
    )


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{v:.1f}" for v in values)


async def write_first_report(path: Path, notebook: Notebook) -> None:
    """`doctor --report` before there is a `rig.toml`: what is known so far, and what the arm answers word for word.

    `check_report` must have passed. Raises OSError.
    """
    scrubber = Scrubber({str(notebook.get(field) or ""): stands_for for field, stands_for in NAMES.items()})
    how = "" if (kind := notebook.values.get("robot.kind")) is None else kind.how
    typed = str(notebook.get("aside.address") or "")
    known = {
        "framing": notebook.framing,
        "findings": [scrubber.value(Finding("robot", typed, answers=bool(how), notes=how).as_json())],
        "done": notebook.done,
        "taught": numbers_only(notebook.table("")),
        "touched": {name: touch.position_mm for name, touch in notebook.touches.items()},
    }
    address = Address.of(typed) if typed else None
    answers = "" if address is None else await transcript(address.host, address.port, notebook.framing, scrubber)
    write_archive(path, known, {"arcs.jsonl": answers})
