"""Step 1: find the arm; and what every step reads of it. Its address is asked for: nothing is set, powered or moved."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.collect.commission.notebook import Notebook, Taught
from brushloop.collect.commission.step import Asked, Step, Visit
from brushloop.collect.rig.doctor import Finding, Scrubber, numbers_only, transcript, write_archive
from brushloop.drivers.arcs.controller import MOVING_ALLOWED, Controller, only_asking
from brushloop.drivers.arcs.wire import DEVICE, Framing, answers, numbers
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, ProtocolViolation, RpcError
from brushloop.drivers.geometry import distance, from_wire

ARCS_PORT, RTDE_PORT = 30004, 30010
NAMES = {
    "robot.host": "<host>",
    "aside.address": "<host>",
    "camera.source": "<camera>",
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


def address_of(text: str) -> tuple[str, int]:
    """Host and port from `HOST` or `HOST:PORT`. Raises ValueError, worded for the person who typed it."""
    host, _, port = text.strip().partition(":")
    if not host or any(c.isspace() for c in host):
        raise ValueError(f"{text!r} is not an address like 192.0.2.7 or 192.0.2.7:{ARCS_PORT}")
    port = port or str(ARCS_PORT)
    if not (port.isdecimal() and len(port) <= 5 and 1 <= int(port) <= 65535):
        raise ValueError(f"port {port!r} is not a number from 1 to 65535")
    return host, int(port)


ADDRESS = Asked(
    "aside.address",
    f"Address of the cabinet (pendant: Settings, Network), as 192.0.2.7 or 192.0.2.7:{ARCS_PORT}",
    read=lambda line: "{}:{}".format(*address_of(line)),
)


class Cabinet(NamedTuple):
    """What a cabinet reports about itself and its arm."""

    who: str
    """Model, control box and software."""
    modes: tuple[str, str, str]
    """Of the robot, of its safety, and of the mode switch."""
    tcp_mm_deg: tuple[float, ...]
    """Flange to tool as set on the pendant: x, y, z in mm, rx, ry, rz in deg."""
    payload_kg: float
    payload_cog_mm: list[float]
    collision_level: int


class ArmReader:
    """One connection on which nothing but what is below is asked. Every method may raise `DeviceError`."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    async def _ask(self, method: str) -> Any:
        if self._controller.connection.lost:
            await self._controller.connection.open()
        return await self._controller.ask(method)

    async def flange(self) -> Pose:
        """Wait until the arm is held still, and return the pose of the flange in the base frame.

        Raises `DeviceTimeout` if the arm keeps moving.
        """
        before = await self._flange_now()
        try:
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    await asyncio.sleep(STILL_S)
                    here = await self._flange_now()
                    moved_mm, turned_deg = distance(before, here)
                    if moved_mm < STILL_MM and turned_deg < STILL_DEG:
                        return here
                    before = here
        except TimeoutError:
            raise DeviceTimeout(
                DEVICE, "getTcpPose", f"the arm did not rest for {PATIENCE_S:g} s", remedy="Hold it still."
            ) from None

    async def _flange_now(self) -> Pose:
        """From the cabinet's tool pose, with its tool taken off again: whatever is set there does not matter."""
        tool = numbers("getTcpOffset", await self._ask("RobotConfig.getTcpOffset"))
        at = from_wire(numbers("getTcpPose", await self._ask("RobotState.getTcpPose")))
        turn = Rotation.from_quat(at.quaternion) * Rotation.from_euler("ZYX", tool[5:2:-1]).inv()
        x, y, z = np.array(at.position_mm) - turn.apply(1e3 * np.array(tool[:3]))
        qx, qy, qz, qw = (float(v) for v in turn.as_quat())
        return Pose(float(x), float(y), float(z), qx, qy, qz, qw)

    async def cabinet(self) -> Cabinet:
        """Everything that the cabinet reports about itself."""
        call = self._controller.connection.call
        software = f"interface {await call('SystemInfo.getInterfaceVersionCode')}"
        with contextlib.suppress(RpcError):
            software += f", {await call('SystemInfo.getControlSoftwareFullVersion')}"
        model, box = await self._ask("RobotConfig.getRobotType"), await self._ask("RobotConfig.getControlBoxType")
        tool = numbers("getTcpOffset", await self._ask("RobotConfig.getTcpOffset"))
        level = await self._ask("RobotConfig.getCollisionLevel")
        if type(level) is not int:
            raise ProtocolViolation(DEVICE, "getCollisionLevel", f"expected a whole number, got {level!r}")
        payload_kg, centre_mm = await self._controller.payload()
        getters = ("RobotState.getRobotModeType", "RobotState.getSafetyModeType", "RobotManage.getOperationalMode")
        robot_mode, safety_mode, switch = [str(await self._ask(getter)) for getter in getters]
        return Cabinet(
            f"{model} ({box}), {software}",
            (robot_mode, safety_mode, switch),
            (*(1e3 * v for v in tool[:3]), *map(math.degrees, tool[3:])),
            payload_kg,
            centre_mm,
            level,
        )


def tip_of(flange: Pose, offset_mm: Sequence[float]) -> tuple[float, float, float]:
    """Where the tip is while the flange is there, in the base frame."""
    x, y, z = np.array(flange.position_mm) + Rotation.from_quat(flange.quaternion).apply(offset_mm)
    return float(x), float(y), float(z)


@contextlib.asynccontextmanager
async def taught_arm(notebook: Notebook) -> AsyncGenerator[ArmReader]:
    """The arm that was taught, for reading only."""
    host, port = str(notebook.get("robot.host")), int(notebook.number("robot.port"))
    async with only_asking(host, port, notebook.framing) as controller:
        yield ArmReader(controller)


async def touch(visit: Visit, reader: ArmReader, thing: str, how: str, *, may_skip: bool = False) -> Pose | None:
    """Ask for the tip to be brought to a thing, and note the flange's pose there; None if the person skips it.

    A thing that was touched before is not asked for again.
    """
    if thing in visit.notebook.touches:
        return visit.notebook.touches[thing]
    if not await visit.brought(thing, how, may_skip=may_skip):
        return None
    flange = await reader.flange()
    visit.save(visit.notebook.with_touch(thing, flange))
    x, y, z = flange.position_mm
    visit.say(f"{thing}: the flange is at ({x:.2f}, {y:.2f}, {z:.2f}) mm")
    return flange


async def find_framing(host: str, port: int) -> tuple[Framing, Cabinet]:
    """The framing that the controller answers, and what it reports. Raises the first framing's `DeviceError`."""
    first: DeviceError | None = None
    for framing in FRAMINGS:
        try:
            async with only_asking(host, port, framing) as controller:
                return framing, await ArmReader(controller).cabinet()
        except ConnectionLost:
            raise
        except (DeviceTimeout, ProtocolViolation) as error:
            first = first or error
    assert first is not None
    raise first


class ArmStep(Step):
    """Address, ports, framing, model, firmware, safety state, and what the cabinet says of tool and payload."""

    name = "arm"
    title = "Find the arm"
    minutes = 3
    needs = ()
    observes = (ADDRESS.field,)

    async def carry_out(self, visit: Visit) -> None:
        """Ask for the address and read everything else. Raises `DeviceError`."""
        await visit.values(ADDRESS)
        host, port = address_of(str(visit.notebook.get(ADDRESS.field)))
        visit.working(f"asking {host}:{port} who it is")
        framing, cabinet = await find_framing(host, port)
        robot_mode, safety_mode, switch = cabinet.modes
        tcp = [f"{v:.1f}" for v in cabinet.tcp_mm_deg]
        visit.say(
            f"{host}:{port} answers in the {framing} framing: {cabinet.who}",
            f"robot mode {robot_mode}, safety {safety_mode}, mode switch {switch}",
            f"tool set on the pendant: {', '.join(tcp[:3])} mm, turned by {', '.join(tcp[3:])} deg; "
            f"payload {cabinet.payload_kg:g} kg; collision level {cabinet.collision_level}",
        )
        tool_mm = math.hypot(*cabinet.tcp_mm_deg[:3])
        if tool_mm and not SHORTEST_TOOL_MM <= tool_mm <= LONGEST_TOOL_MM:
            visit.say(
                f"The pendant's tool is {tool_mm:.3g} mm long: perhaps metres were typed where millimetres are taken, "
                "or millimetres where metres are. It is measured in the third step and replaced.",
                tone="warning",
            )
        if safety_mode not in MOVING_ALLOWED:
            visit.say(
                f"The safety mode is {safety_mode}: the arm cannot be guided by hand until it is released.",
                "Look at the pendant; this program clears nothing.",
                tone="warning",
            )
        as_set = "as set on the pendant"
        values = {
            "robot.kind": Taught("aubo-arcs", f"{cabinet.who} answered"),
            "robot.host": Taught(host, "typed, and answered"),
            "robot.port": Taught(port, "answered"),
            "robot.framing": Taught(framing, "the first that the controller answered"),
            "robot.payload_kg": Taught(cabinet.payload_kg, as_set, "kg", known="not weighed"),
            "robot.payload_cog_mm": Taught(cabinet.payload_cog_mm, as_set, "mm", known="not measured"),
        }
        if await answers(host, RTDE_PORT):
            values["robot.rtde_port"] = Taught(RTDE_PORT, "answered, and sends poses")
        if cabinet.collision_level:
            values["robot.collision_level"] = Taught(cabinet.collision_level, as_set)
        visit.keep(values)


async def write_first_report(path: Path, notebook: Notebook) -> None:
    """`doctor --report` before there is a `rig.toml`: what is known so far, and what the arm answers word for word.

    `check_report` must have passed. Raises OSError.
    """
    scrubber = Scrubber({str(notebook.get(field) or ""): stands_for for field, stands_for in NAMES.items()})
    how = "" if (kind := notebook.values.get("robot.kind")) is None else kind.how
    typed = str(notebook.get(ADDRESS.field) or "")
    known = {
        "framing": notebook.framing,
        "findings": [scrubber.value(Finding("robot", typed, answers=bool(how), notes=how).as_json())],
        "done": notebook.done,
        "taught": numbers_only(notebook.table("")),
        "touched": {name: touch.position_mm for name, touch in notebook.touches.items()},
    }
    said = await transcript(*address_of(typed), notebook.framing, scrubber) if typed else ""
    write_archive(path, known, {"arcs.jsonl": said})
