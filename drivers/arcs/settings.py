"""What a press depends on and any client may change: read back, and held against what was set."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from drivers.arcs.controller import Controller
from drivers.arcs.numbers import numbers
from drivers.arcs.options import ArcsOptions
from drivers.arcs.rpc import DEVICE
from drivers.errors import ProtocolViolation, RpcError, SettingsChanged

METHOD_NOT_FOUND = -32601
TOLERANCE = 1e-3
"""Of every number, in mm, deg and kg: a controller may keep single precision."""

Value = tuple[float, ...] | str | None
"""None: the controller has no such thing."""
Settings = Mapping[str, Value]
"""By name, in the units of `SETTINGS`."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One thing that is set at the controller."""

    name: str
    units: tuple[str, ...]
    getter: str
    read: Callable[[Any], Value]


def _offset(answer: Any) -> Value:
    values = numbers(answer, 6)
    return (*(v * 1e3 for v in values[:3]), *map(math.degrees, values[3:]))


def _payload(answer: Any) -> Value:
    mass_kg, cog_m, *_ = answer
    return (*numbers([mass_kg], 1), *(v * 1e3 for v in numbers(cog_m, 3)))


def _number(answer: Any) -> Value:
    return tuple(numbers([answer], 1))


TOOL_OFFSET, PAYLOAD, COLLISION_LEVEL = "tool offset", "payload", "collision level"
SPEED_FRACTION, OPERATIONAL_MODE = "speed fraction", "operational mode"
SETTINGS = (
    Setting(TOOL_OFFSET, ("mm", "mm", "mm", "deg", "deg", "deg"), "RobotConfig.getTcpOffset", _offset),
    Setting(PAYLOAD, ("kg", "mm", "mm", "mm"), "RobotConfig.getPayload", _payload),
    Setting(COLLISION_LEVEL, ("",), "RobotConfig.getCollisionLevel", _number),
    Setting(SPEED_FRACTION, ("",), "MotionControl.getSpeedFraction", _number),
    Setting(OPERATIONAL_MODE, (), "RobotManage.getOperationalMode", str),
)


async def read_back(controller: Controller) -> Settings:
    """All settings as the controller tells them. Raises `ProtocolViolation` for an answer of another shape."""
    found: dict[str, Value] = {}
    for setting in SETTINGS:
        try:
            found[setting.name] = setting.read(await controller.ask(setting.getter))
        except RpcError as error:
            if error.code != METHOD_NOT_FOUND:
                raise
            found[setting.name] = None
        except (TypeError, ValueError) as error:
            raise ProtocolViolation(DEVICE, setting.getter.rpartition(".")[2], str(error)) from None
    return found


def configured(options: ArcsOptions) -> Settings:
    """What `options` sets; the others are left as they are on the pendant."""
    wanted: dict[str, Value] = {TOOL_OFFSET: (*options.tcp_offset_mm, 0.0, 0.0, 0.0)}
    if options.payload_kg is not None:
        wanted[PAYLOAD] = (options.payload_kg, *options.payload_cog_mm)
    if options.collision_level is not None:
        wanted[COLLISION_LEVEL] = (float(options.collision_level),)
    if options.speed_fraction is not None:
        wanted[SPEED_FRACTION] = (options.speed_fraction,)
    return wanted


def require_same(op: str, wanted: Settings, found: Settings) -> None:
    """Raise `SettingsChanged` naming everything in `wanted` that was found otherwise."""
    changes = tuple(
        f"{setting.name} is {_in_words(setting, found[setting.name])}, not {_in_words(setting, wanted[setting.name])}"
        for setting in SETTINGS
        if setting.name in wanted and not _same(wanted[setting.name], found[setting.name])
    )
    if changes:
        raise SettingsChanged(DEVICE, op, changes)


def _same(wanted: Value, found: Value) -> bool:
    if isinstance(wanted, tuple) and isinstance(found, tuple):
        return all(abs(a - b) <= TOLERANCE for a, b in zip(wanted, found, strict=True))
    return wanted == found


def _in_words(setting: Setting, value: Value) -> str:
    """`(0, 0, 180) mm, (0, 0, 0) deg`."""
    if not isinstance(value, tuple):
        return value or "unknown to the controller"
    parts: list[str] = []
    for unit, group in itertools.groupby(zip(value, setting.units, strict=True), key=lambda pair: pair[1]):
        figures = [f"{round(number, 4) + 0.0:g}" for number, _ in group]
        listed = figures[0] if len(figures) == 1 else f"({', '.join(figures)})"
        parts.append(f"{listed} {unit}".strip())
    return ", ".join(parts)
