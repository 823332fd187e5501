"""Step 1: find the arm; and what every step reads of it. Its address is asked for: nothing is set, powered or moved."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from brushloop.collect.commission.visit import Notebook, Step, Taught, Visit
from brushloop.collect.errors import NotAccepted
from brushloop.collect.operator import Prompt
from brushloop.collect.rig.check import tool_length
from brushloop.collect.rig.doctor import Finding, write_report
from brushloop.drivers.arcs.controller import MOVING_ALLOWED, Controller, only_asking
from brushloop.drivers.arcs.settings import ArcsTable, read_back
from brushloop.drivers.arcs.wire import DEVICE, Framing, answers
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import DeviceError, DeviceTimeout, ProtocolViolation, RpcError
from brushloop.drivers.geometry import distance, from_wire, inverse, product, turned

ARCS_PORT, RTDE_PORT = 30004, 30010
FRAMINGS: tuple[Framing, ...] = ("sof", "bare")
STILL_MM, STILL_DEG = 0.02, 0.01
"""An arm that is held still by hand moves by less than this between two readings."""
STILL_S, PATIENCE_S = 0.1, 20.0
Point = tuple[float, float, float]
HAND_MM = 0.15
"""Smallest plausible error of a touch by hand, in one axis: a few touches may agree by chance."""


def address_of(text: str) -> tuple[str, int]:
    """Host and port from `HOST` or `HOST:PORT`. Raises ValueError, worded for the person who typed it."""
    parts = urlsplit(f"//{text.strip()}")
    if not parts.hostname or any(c.isspace() for c in parts.hostname):
        raise ValueError(f"{text!r} is not an address like 192.0.2.7 or 192.0.2.7:{ARCS_PORT}")
    return parts.hostname, parts.port or ARCS_PORT


ADDRESS = "aside.address"
ASK_ADDRESS = Prompt(
    f"Address of the cabinet (pendant: Settings, Network), as 192.0.2.7 or 192.0.2.7:{ARCS_PORT}",
    read=lambda line: "{}:{}".format(*address_of(line)),
)


async def taught_flange(notebook: Notebook) -> Pose:
    """Where the flange of the arm that was taught is at rest, in the base frame. Raises `DeviceError`."""
    table = notebook.table("robot.")
    async with only_asking(table["host"], table["port"], table["framing"]) as controller:
        return await _flange_at_rest(controller)


async def _flange_at_rest(controller: Controller) -> Pose:
    """Wait until the arm is held still. Raises `DeviceTimeout` if it keeps moving."""
    before = await _flange(controller)
    try:
        async with asyncio.timeout(PATIENCE_S):
            while True:
                await asyncio.sleep(STILL_S)
                here = await _flange(controller)
                moved_mm, turned_deg = distance(before, here)
                if moved_mm < STILL_MM and turned_deg < STILL_DEG:
                    return here
                before = here
    except TimeoutError:
        raise DeviceTimeout(
            DEVICE, "getTcpPose", f"the arm did not come to rest within {PATIENCE_S:g} s", remedy="Hold the arm still."
        ) from None


async def _flange(controller: Controller) -> Pose:
    """From the cabinet's tool pose, with its tool taken off again: whatever is set there does not matter."""
    tool = from_wire(await controller.ask_numbers("RobotConfig.getTcpOffset"))
    tip = await controller.pose()
    turn = product(tip.quaternion, inverse(tool.quaternion))
    x, y, z = (at - offset for at, offset in zip(tip.position_mm, turned(turn, tool.position_mm), strict=True))
    return Pose(x, y, z, *turn)


def tip_of(flange: Pose, offset_mm: Sequence[float]) -> Point:
    """Where the tip is while the flange is there, in the base frame."""
    x, y, z = (at + offset for at, offset in zip(flange.position_mm, turned(flange.quaternion, offset_mm), strict=True))
    return x, y, z


def tips(notebook: Notebook) -> dict[str, Point]:
    """The tip at everything that was touched, by name, in the base frame."""
    offset_mm = notebook.get("robot.tcp_offset_mm")
    return {name: tip_of(flange, offset_mm) for name, flange in notebook.touches.items()}


async def touch(visit: Visit, thing: str, how: str, *, may_skip: bool = False) -> bool:
    """Ask for the tip to be brought to a thing, and note the flange's pose there; False if the person skips it.

    A thing that was touched before is not asked for again. Raises `DeviceError`.
    """
    if thing in visit.notebook.touches:
        return True
    if not await visit.brought(thing, how, may_skip=may_skip):
        return False
    flange = await taught_flange(visit.notebook)
    visit.save(visit.notebook.with_touch(thing, flange))
    x, y, z = flange.position_mm
    name = " ".join(word for word in thing.split() if not word.isdecimal())
    visit.say(f"✓ {name}: the flange is at ({x:.2f}, {y:.2f}, {z:.2f}) mm")
    return True


async def find_framing(host: str, port: int) -> Framing:
    """The framing that the controller answers. Raises the first framing's `DeviceError`."""
    errors = list[DeviceError]()
    for framing in FRAMINGS:
        try:
            async with only_asking(host, port, framing):
                return framing
        except (DeviceTimeout, ProtocolViolation) as error:
            errors.append(error)
    raise errors[0]


async def _name(controller: Controller) -> str:
    """Model, control box and software."""
    call = controller.call
    software = f"interface {await call('SystemInfo.getInterfaceVersionCode')}"
    with contextlib.suppress(RpcError):
        software += f", {await call('SystemInfo.getControlSoftwareFullVersion')}"
    model, box = [await controller.ask(f"RobotConfig.{getter}") for getter in ("getRobotType", "getControlBoxType")]
    return f"{model} ({box}), {software}"


class ArmStep(Step):
    """Address, ports, framing, model, firmware, safety state, and what the cabinet says of tool and payload."""

    name = "arm"
    title = "Find the arm"
    minutes = 3
    observes = (ADDRESS,)

    async def carry_out(self, visit: Visit) -> None:
        """Ask for the address and read everything else. Raises `DeviceError`."""
        host, port = address_of(await visit.value(ADDRESS, ASK_ADDRESS))
        visit.working(f"asking {host}:{port} for its name")
        framing = await find_framing(host, port)
        async with only_asking(host, port, framing) as controller:
            name, settings = await _name(controller), await read_back(controller)
            mode, safety = await controller.mode(), await controller.safety()
        visit.say(
            f"{host}:{port} is {name} ({framing} framing)",
            f"robot mode {mode}, safety {safety}",
            f"set on the pendant: {'; '.join(f'{setting} {value}' for setting, value in settings.words().items())}",
        )
        tool = tool_length(settings.tool.position_mm)
        if any(settings.tool.position_mm) and tool.verdict == "contradicts":
            why = f"The tool set on the pendant is {tool.value} long; {tool.allowed} are plausible. {tool.remedy}"
            visit.say(why, "The third step measures the tool and replaces this value.", tone="warning")
        if safety not in MOVING_ALLOWED:
            visit.say(
                f"The safety mode is {safety}: the arm cannot be guided by hand until this mode has ended.",
                "End this mode at the pendant; brushloop never does that.",
                tone="warning",
            )
        as_set, (payload_kg, *cog_mm) = "as set on the pendant", settings.payload
        question = "The payload is 0 kg, but holder and brush have weight: a guided arm will drift. Go on with 0 kg?"
        if not payload_kg and not await visit.yes(question):
            raise NotAccepted("the payload is 0 kg.", "Weigh holder, sensor and brush; set the weight on the pendant.")
        values = {
            "robot.kind": Taught("aubo-arcs", f"{name} answered"),
            "robot.host": Taught(host, "typed; the controller answered there"),
            "robot.port": Taught(port, "the controller answered there"),
            "robot.framing": Taught(framing, "the first framing that the controller answered"),
            "robot.payload_kg": Taught(payload_kg, as_set, known="not weighed"),
            "robot.payload_cog_mm": Taught(cog_mm, as_set, known="not measured"),
        }
        if await answers(host, RTDE_PORT):
            values["robot.rtde_port"] = Taught(RTDE_PORT, "the controller answered there; it sends poses")
        if settings.collision_level:
            values["robot.collision_level"] = Taught(int(settings.collision_level), as_set)
        visit.keep(values)


async def write_first_report(path: Path, notebook: Notebook) -> None:
    """`doctor --report` before there is a `rig.toml`: what is known so far, and what the arm answers word for word.

    The address of the arm must be known. Raises OSError.
    """
    rig, kind = notebook.table(""), notebook.values.get("robot.kind")
    host, port = address_of(rig[ADDRESS])
    robot = ArcsTable(
        kind="aubo-arcs",
        host=host,
        port=port,
        framing=rig.get("robot.framing", FRAMINGS[0]),
        rtde_port=rig.get("robot.rtde_port"),
        tcp_offset_mm=(0.0, 0.0, 0.0),
    )
    finding = Finding("robot", rig[ADDRESS], answers=kind is not None, notes="" if kind is None else kind.how)
    touched = {name: touch.position_mm for name, touch in notebook.touches.items()}
    await write_report(path, rig, robot, [finding], done=notebook.done, touched=touched)
