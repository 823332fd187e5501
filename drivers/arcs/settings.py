"""How an arm is set up, what is read back, and what must still be so before a line is sent.

Any client may change these settings and use the arm, so a return code proves nothing, and everything is checked again
before each departure. No step here moves the arm or clears a stop.
"""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from brushloop.drivers.arcs.controller import Controller, RobotMode, WrongOperationalMode, accepted
from brushloop.drivers.arcs.motion import POLL_S
from brushloop.drivers.arcs.wire import DEVICE, Framing, numbers
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import (
    ArmMoved,
    DeviceTimeout,
    NotConnected,
    NotPowered,
    ProtocolViolation,
    SettingsChanged,
)
from brushloop.drivers.geometry import distance, from_wire
from brushloop.drivers.limits import Limits

Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
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
    watchdog_s: Annotated[float, Field(ge=0.5, le=60.0)] | None = None
    """Dead-man switch on the controller: after this long without a sign of life it makes a protective stop, which only
    a person can release and which leaves the brush where it is. If left out, it is not armed, and a press lifts by
    itself."""
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

Value = tuple[float, ...] | str
Settings = Mapping[str, Value]
"""By name, in the units of `SETTINGS`."""


Command = tuple[str, dict[str, Any]]
"""Name and parameters of a method of `RobotConfig`."""
PER_WIRE_UNIT = {"mm": 1e3, "deg": 180.0 / math.pi, "kg": 1.0, "": 1.0}
"""How many of a unit are one unit of the wire, which has m, rad and kg."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting of the controller: numbers in `units`, or a text where there are none."""

    name: str
    units: tuple[str, ...]
    getter: str
    pick: Callable[[Any], Any] = lambda answer: [answer]
    """Finds the numbers in an answer."""
    setter: Callable[[list[float]], Command] | None = None
    """How it is set, from numbers as on the wire; None for one that is only read back."""

    def value(self, answer: Any) -> Value:
        """What an answer says. Raises `ProtocolViolation` if it has another shape."""
        if not self.units:
            return str(answer)
        op = self.getter.rpartition(".")[2]
        try:
            picked = self.pick(answer)
        except (TypeError, ValueError) as error:
            raise ProtocolViolation(DEVICE, op, str(error)) from None
        wire = numbers(op, picked, len(self.units))
        return tuple(number * PER_WIRE_UNIT[unit] for number, unit in zip(wire, self.units, strict=True))

    def wire(self, value: tuple[float, ...]) -> list[float]:
        """The numbers as they go over the wire."""
        return [number / PER_WIRE_UNIT[unit] for number, unit in zip(value, self.units, strict=True)]


def _mass_and_centre(answer: Any) -> list[Any]:
    mass_kg, cog_m, *_ = answer
    return [mass_kg, *cog_m]


def _set_offset(wire: list[float]) -> Command:
    return "setTcpOffset", {"offset": wire}


def _set_payload(wire: list[float]) -> Command:
    return "setPayload", {"m": wire[0], "cog": wire[1:], "aom": [0.0] * 3, "inertia": [0.0] * 6}


def _set_collision_level(wire: list[float]) -> Command:
    return "setCollisionLevel", {"level": int(wire[0])}


PAYLOAD, COLLISION_LEVEL, OPERATIONAL_MODE = "payload", "collision level", "operational mode"
TOOL = Setting(
    "tool offset", ("mm",) * 3 + ("deg",) * 3, "RobotConfig.getTcpOffset", lambda answer: answer, _set_offset
)
SETTINGS = (
    TOOL,
    Setting(PAYLOAD, ("kg", "mm", "mm", "mm"), "RobotConfig.getPayload", _mass_and_centre, _set_payload),
    Setting(COLLISION_LEVEL, ("",), "RobotConfig.getCollisionLevel", setter=_set_collision_level),
    Setting("speed fraction", ("",), "MotionControl.getSpeedFraction"),
    Setting(OPERATIONAL_MODE, (), "RobotManage.getOperationalMode"),
)


async def read_back(controller: Controller) -> Settings:
    """Read all settings from the controller. Raises `ProtocolViolation` for an answer of the wrong shape."""
    return {setting.name: setting.value(await controller.ask(setting.getter)) for setting in SETTINGS}


def configured(table: ArcsTable) -> dict[str, tuple[float, ...]]:
    """The settings that `table` gives; the others stay as they are on the pendant."""
    wanted: dict[str, tuple[float, ...]] = {TOOL.name: (*table.tcp_offset_mm, *table.tcp_rotation_deg)}
    if table.payload_kg is not None:
        wanted[PAYLOAD] = (table.payload_kg, *table.payload_cog_mm)
    if table.collision_level is not None:
        wanted[COLLISION_LEVEL] = (float(table.collision_level),)
    return wanted


def require_same(op: str, wanted: Settings, current: Settings) -> None:
    """Raise `SettingsChanged` naming every setting in `wanted` that was found different."""
    changes = [
        f"{setting.name} is {_in_words(setting, current[setting.name])}, not {_in_words(setting, wanted[setting.name])}"
        for setting in SETTINGS
        if setting.name in wanted and not _same(setting, wanted[setting.name], current[setting.name])
    ]
    if changes:
        raise SettingsChanged(DEVICE, op, "; ".join(changes))


def _same(setting: Setting, wanted: Value, current: Value) -> bool:
    if not isinstance(wanted, tuple) or not isinstance(current, tuple):
        return wanted == current
    if setting is TOOL:  # one rotation has several sets of angles, such as 180 and -180 deg
        return max(distance(from_wire(TOOL.wire(wanted)), from_wire(TOOL.wire(current)))) <= TOLERANCE
    return all(abs(a - b) <= TOLERANCE for a, b in zip(wanted, current, strict=True))


def _in_words(setting: Setting, value: Value) -> str:
    """`(0, 0, 180) mm, (0, 0, 0) deg`."""
    if not isinstance(value, tuple):
        return value
    parts: list[str] = []
    for unit, group in itertools.groupby(zip(value, setting.units, strict=True), key=lambda pair: pair[1]):
        figures = [f"{round(number, 4) + 0.0:g}" for number, _ in group]
        listed = figures[0] if len(figures) == 1 else f"({', '.join(figures)})"
        parts.append(f"{listed} {unit}".strip())
    return ", ".join(parts)


async def make_ready(controller: Controller, table: ArcsTable, on_notice: Callable[[str], None]) -> Settings:
    """Check the operational mode, set tool, payload and collision level, where configured, and read all back.

    Raises `WrongOperationalMode`, `MotionRefused` for a setting that the controller refuses, and `SettingsChanged` for
    one that it accepted but did not apply.
    """
    mode = (await read_back(controller))[OPERATIONAL_MODE]
    if mode == "Disabled":
        on_notice("operational modes are disabled on this cabinet")
    elif mode != "Automatic":  # manual and unknown modes are for a person next to the arm
        raise WrongOperationalMode(DEVICE, "power on", str(mode))
    wanted = configured(table)
    for setting in SETTINGS:
        if setting.setter is not None and setting.name in wanted:
            method, params = setting.setter(setting.wire(wanted[setting.name]))
            accepted(method, await controller.ask(f"RobotConfig.{method}", **params))
    settings = await read_back(controller)
    require_same("power on", wanted, settings)
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
            raise DeviceTimeout(
                DEVICE,
                "power on",
                f"mode {mode} did not become {' or '.join(sorted(wanted))}",
                remedy="Look at the pendant: a confirmation may be waiting there.",
            )
        await asyncio.sleep(POLL_S)


MOVED_MM, MOVED_DEG = 0.5, 0.5
"""Limits beyond which another client or a person moved the arm: larger than the tolerance of any settled move."""
DOWN_MM = 0.01
"""A line that ends more than this lower counts as going down."""
RESTS_S = 0.5
"""Longest wait for rest: an arm that has just settled may take a moment to report it."""


class Departure:
    """Place and settings in which one arm was left."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._settings: Settings = {}
        self.left: Pose | None = None
        """Where the last line ended, or where `take_up` found the arm; None after a line that did not reach its end."""

    async def enabled(self, settings: Settings) -> None:
        """Note the settings with which the arm was enabled, and its place."""
        self._settings = settings
        self.left = await self._controller.pose()

    async def take_up(self) -> Pose:
        """Accept the place where the arm rests as the start of the next line.

        Raises `ArmMoved` while it moves, `SettingsChanged` if a pose would refer to another tool, `RobotNotSafe`,
        `NotPowered`.
        """
        await self._require_rest("take up")
        await self._require_settings("take up")
        self.left = await self._controller.pose()
        return self.left

    async def confirm(self) -> None:
        """Check that all is as it was left. Raises `RobotNotSafe`, `NotPowered`, `SettingsChanged`, then `ArmMoved`."""
        await self._require_settings("confirm")
        await self._require_rest("confirm")
        self._require_place("confirm", await self._controller.pose())

    async def ready(self, op: str, limits: Limits, poses: Sequence[Pose]) -> Pose:
        """Return where the arm is, once it may go from there through `poses`.

        Raises as `confirm` does, and `LimitExceeded` if a line would leave the limits.
        """
        await self._require_rest(op)
        start = await self._controller.pose()
        path = [start, *poses]
        down = any(b.z_mm < a.z_mm - DOWN_MM for a, b in itertools.pairwise(path))
        if down or self._moved(start):
            await self._require_settings(op)  # with another tool, the same place would look like another
        self._require_place(op, start)
        for a, b in itertools.pairwise(path):
            limits.check_way(DEVICE, a, b)
        return start

    async def _require_settings(self, op: str) -> None:
        self._require_enabled(op)
        values = await read_back(self._controller)
        await self._controller.require_safe(op)
        if await self._controller.mode() != RobotMode.RUNNING:
            raise NotPowered(DEVICE, op)
        require_same(op, self._settings, values)

    async def _require_rest(self, op: str) -> None:
        self._require_enabled(op)
        loop = asyncio.get_running_loop()
        until = loop.time() + RESTS_S
        while not await self._controller.at_rest():
            if loop.time() > until:
                await self._controller.require_safe(op)  # a safety stop holds its path: that is the cause to report
                raise ArmMoved(DEVICE, op, *self._off(await self._controller.pose()), moving=True)
            await asyncio.sleep(POLL_S)

    def _require_enabled(self, op: str) -> None:
        if not self._settings:
            raise NotConnected(DEVICE, op, "not enabled")

    def _require_place(self, op: str, here: Pose) -> None:
        if self._moved(here):
            raise ArmMoved(DEVICE, op, *self._off(here))

    def _moved(self, here: Pose) -> bool:
        off_mm, off_deg = self._off(here)
        return off_mm > MOVED_MM or off_deg > MOVED_DEG

    def _off(self, here: Pose) -> tuple[float, float]:
        return (0.0, 0.0) if self.left is None else distance(self.left, here)
