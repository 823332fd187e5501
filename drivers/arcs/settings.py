"""How an arm is set up, and what is read back: any client may change these settings, so a return code proves nothing.

No step here moves the arm or clears a stop.
"""

import asyncio
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field

from brushloop.drivers.arcs.controller import Controller, RobotMode, accepted
from brushloop.drivers.arcs.motion import POLL_S
from brushloop.drivers.arcs.wire import DEVICE, Framing, numbers
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import DeviceTimeout, MotionError, ProtocolViolation, SettingsChanged
from brushloop.drivers.geometry import angles, distance, from_wire
from brushloop.drivers.limits import Finite

Turn = Annotated[float, Field(ge=-180.0, le=180.0)]


class ArcsTable(BaseModel, frozen=True, extra="forbid"):
    """The table `[robot]` of `rig.toml` but for the limits: where the controller is and how the arm is set up."""

    kind: Literal["aubo-arcs"]
    host: str = Field(min_length=1)
    port: int = Field(30004, ge=1, le=65535)
    tcp_offset_mm: tuple[Finite, Finite, Finite]
    """Flange to brush tip, along the flange's axes."""
    tcp_rotation_deg: tuple[Turn, Turn, Turn] = (0.0, 0.0, 0.0)
    """Turn from the flange's axes to the brush's: about x, then y, then z of the flange. The brush is along its z."""
    framing: Framing = "sof"
    """`sof` as in the maker's client, `bare` as in the maker's documentation."""
    rtde_port: int | None = Field(None, ge=1, le=65535)
    """Port that pushes poses (30010); if left out, poses are polled."""
    max_pose_lag_ms: Annotated[float, Field(ge=60.0, le=5000.0)] = 100.0
    """Presses and touches during which poses arrive later than this are void: at 20 mm/s the recorded tip is 2 mm away
    from where force and camera saw it after 100 ms. Below 60 ms a busy computer's own lag would count."""
    collision_level: Annotated[int, Field(ge=1, le=9)] | None = None
    """1 to 9 (most sensitive); if left out, the pendant's setting stays."""
    payload_kg: Annotated[float, Field(ge=0.0, le=5.0)] | None = None
    """Mass of sensor, holder and brush; an i5 carries 5 kg. If left out, the pendant's setting stays."""
    payload_cog_mm: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Centre of that mass, from the flange."""


POWER_S = 60.0
"""Longest wait for a mode: brakes take seconds, and a person may have to confirm on the pendant."""
TOLERANCE = 1e-3
"""Largest difference in mm, deg and kg: a controller may keep single precision."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What a press depends on, as the controller reports it."""

    tool: Pose
    """Brush tip in the flange's frame."""
    payload: tuple[float, ...]
    """Mass in kg, then its centre in mm."""
    collision_level: float
    speed_fraction: float
    operational_mode: str

    def words(self) -> dict[str, str]:
        """Each setting by its name, for messages."""
        tool_mm, turn_deg = self.tool.position_mm, map(math.degrees, angles(self.tool.quaternion))
        return {
            "tool offset": f"{_listed(tool_mm)} mm, {_listed(turn_deg)} deg",
            "payload": f"{_figures(self.payload[0])} kg, {_listed(self.payload[1:])} mm",
            "collision level": _figures(self.collision_level),
            "speed fraction": _figures(self.speed_fraction),
            "operational mode": self.operational_mode,
        }

    def require(self, op: str, wanted: Self) -> None:
        """Raise `SettingsChanged` naming every setting that is not as wanted."""
        same = (
            max(distance(self.tool, wanted.tool)) <= TOLERANCE,  # one rotation has several sets of angles
            math.dist(self.payload, wanted.payload) <= TOLERANCE,
            abs(self.collision_level - wanted.collision_level) <= TOLERANCE,
            abs(self.speed_fraction - wanted.speed_fraction) <= TOLERANCE,
            self.operational_mode == wanted.operational_mode,
        )
        settings = zip(self.words().items(), wanted.words().values(), same, strict=True)
        changes = [f"{name} is {now}, not {before}" for (name, now), before, unchanged in settings if not unchanged]
        if changes:
            raise SettingsChanged(DEVICE, op, "; ".join(changes))


def _figures(number: float) -> str:
    return f"{round(number, 4) + 0.0:g}"


def _listed(numbers: Iterable[float]) -> str:
    return f"({', '.join(map(_figures, numbers))})"


async def read_back(controller: Controller) -> Settings:
    """Read all settings from the controller. Raises `ProtocolViolation` for an answer of the wrong shape."""
    offset = await controller.ask_numbers("RobotConfig.getTcpOffset")
    match await controller.ask("RobotConfig.getPayload"):
        case [mass_kg, [*centre_m], *_]:
            mass_kg, *centre_m = numbers("getPayload", [mass_kg, *centre_m], 4)
        case other:
            raise ProtocolViolation(DEVICE, "getPayload", f"expected mass and centre, got {other!r}")
    [level] = await controller.ask_numbers("RobotConfig.getCollisionLevel", 1)
    [fraction] = await controller.ask_numbers("MotionControl.getSpeedFraction", 1)
    mode = str(await controller.ask("RobotManage.getOperationalMode"))
    return Settings(from_wire(offset), (mass_kg, *(1e3 * v for v in centre_m)), level, fraction, mode)


async def make_ready(controller: Controller, table: ArcsTable) -> Settings:
    """Check the operational mode, set tool, payload and collision level, where configured, and read all back.

    Raises `MotionError` in a mode that is for a person next to the arm, `MotionRefused` for a setting that the
    controller refuses, and `SettingsChanged` for one that it accepted but did not apply.
    """
    wanted = await read_back(controller)
    if wanted.operational_mode not in ("Automatic", "Disabled"):
        what, condition = f"operational mode is {wanted.operational_mode}", "Nothing was set or powered."
        remedy = "Set the mode to Automatic on the pendant; brushloop never does that."
        raise MotionError(DEVICE, "power on", what, condition=condition, remedy=remedy)
    offset = [*(mm / 1e3 for mm in table.tcp_offset_mm), *map(math.radians, table.tcp_rotation_deg)]
    commands: dict[str, dict[str, object]] = {"setTcpOffset": {"offset": offset}}
    wanted = replace(wanted, tool=from_wire(offset))
    if table.payload_kg is not None:
        centre_m = [mm / 1e3 for mm in table.payload_cog_mm]
        commands["setPayload"] = {"m": table.payload_kg, "cog": centre_m, "aom": [0.0] * 3, "inertia": [0.0] * 6}
        wanted = replace(wanted, payload=(table.payload_kg, *table.payload_cog_mm))
    if table.collision_level is not None:
        commands["setCollisionLevel"] = {"level": table.collision_level}
        wanted = replace(wanted, collision_level=table.collision_level)
    for method, params in commands.items():
        accepted(method, await controller.ask(f"RobotConfig.{method}", **params))
    settings = await read_back(controller)
    settings.require("power on", wanted)
    return settings


async def power_on(controller: Controller) -> None:
    """Power the arm and release its brakes, if need be. Raises `RobotNotSafe`, `DeviceTimeout`."""
    await controller.require_safe("power on")
    mode = await controller.mode()
    if mode == RobotMode.POWERING_OFF:  # a request for power would be ignored
        await _until_mode(controller, RobotMode.POWER_OFF)
    if mode != RobotMode.RUNNING:
        await controller.ask("RobotManage.poweron")
        await _until_mode(controller, RobotMode.IDLE, RobotMode.RUNNING)
        await controller.ask("RobotManage.startup")
        await _until_mode(controller, RobotMode.RUNNING)


async def _until_mode(controller: Controller, *wanted: RobotMode) -> None:
    """Return once the robot mode is one of `wanted`. Raises `RobotNotSafe`, `DeviceTimeout`."""
    loop = asyncio.get_running_loop()
    until_s = loop.time() + POWER_S
    while (mode := await controller.mode()) not in wanted:
        await controller.require_safe("power on")
        if loop.time() > until_s:
            what = f"the mode stayed {mode}; expected {' or '.join(sorted(wanted))}"
            remedy = "Look at the pendant: a confirmation may be waiting there."
            raise DeviceTimeout(DEVICE, "power on", what, remedy=remedy)
        await asyncio.sleep(POLL_S)
