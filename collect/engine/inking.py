"""Keeps the well filled, with the station's gauge or by counting dips."""

from __future__ import annotations

from dataclasses import dataclass

from collect.errors import NeedsOperator
from collect.rig.config_devices import InkStationConfig, ModbusPumpConfig
from collect.rig.devices import Rig

LEVEL_RISES = 0.005
"""A dose that raises the level by less has not arrived."""


@dataclass(frozen=True, slots=True)
class InkSeen:
    """The well before a dip."""

    level: float | None
    """0 to 1; None where nothing can tell."""
    dosed_ml: float
    """By this device since it was connected."""
    light: float | None = None


class Inking:
    """The ink device of a rig between presses; does nothing where there is none."""

    def __init__(self, rig: Rig) -> None:
        self._ink = rig.ink
        self._config = rig.config.ink.device
        self._dips = 0
        self._dosed_ml = 0.0
        self._light: float | None = None

    async def begin(self) -> None:
        """Set the light, once per run. Raises `DeviceError`."""
        light = self._config.light if isinstance(self._config, InkStationConfig) else None
        if self._ink is not None and light is not None and await self._ink.light(light):
            self._light = light

    async def before_dip(self) -> InkSeen:
        """Fill up if need be. Raises `NeedsOperator` where doses do not arrive, and `DeviceError`."""
        level = None
        match self._config:
            case InkStationConfig():
                level = await self._to_level(self._config)
            case ModbusPumpConfig():
                await self._by_count(self._config)
            case None:
                pass
        return InkSeen(level, self._dosed_ml, self._light)

    async def _to_level(self, config: InkStationConfig) -> float | None:
        assert self._ink is not None
        level = await self._ink.level()
        while level is not None and level < config.keep_level:
            await self._ink.dose(config.dose_ml)
            self._dosed_ml += config.dose_ml
            before, level = level, await self._ink.level()
            if level is not None and level < before + LEVEL_RISES:
                raise NeedsOperator(
                    f"a dose of {config.dose_ml:g} ml left the well at {level:.0%} of its capacity: "
                    "look at the tube, the reservoir and the gauge"
                )
        return level

    async def _by_count(self, config: ModbusPumpConfig) -> None:
        assert self._ink is not None
        if self._dips % config.every_dips == config.every_dips - 1:
            await self._ink.dose(config.dose_ml)
            self._dosed_ml += config.dose_ml
        self._dips += 1
