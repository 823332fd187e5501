"""How much ink a plan needs, at most."""

from __future__ import annotations

import math
from dataclasses import dataclass

from collect.rig.config import BrushConfig, RigConfig
from collect.rig.config_devices import ModbusPumpConfig

HELD_SHARE = 0.3
"""Share of a wet bundle's volume that is ink between the hairs. An assumption: weigh a dipped brush to do better."""


@dataclass(frozen=True, slots=True)
class InkNeed:
    """An upper estimate, and what it rests on."""

    ml: float
    why: str


def bundle_ml(brush: BrushConfig) -> float:
    """Volume of the bundle as a cone of its largest radius and its length."""
    return math.pi * brush.radius_mm**2 * brush.length_mm / 3.0 / 1e3


def ink_need(config: RigConfig, dips: int) -> InkNeed:
    """Every dip is counted as a full load, as if each mark emptied the brush; a pump's own dose, where it has one, says
    better what a dip takes."""
    device = config.ink.device
    if isinstance(device, ModbusPumpConfig):
        doses = dips // device.every_dips
        return InkNeed(
            doses * device.dose_ml,
            f"what the pump gives: {device.dose_ml:g} ml before every {device.every_dips}. dip",
        )
    load_ml = HELD_SHARE * bundle_ml(config.brush)
    return InkNeed(
        dips * load_ml,
        f"at most: every dip a full load of {load_ml:.2f} ml, {HELD_SHARE:.0%} of the bundle's volume (assumed)",
    )
