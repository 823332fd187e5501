"""Walks a protocol without moving: every pose against the limits, before anything is connected."""

from __future__ import annotations

from pathlib import Path

from collect.config import GridConfig, RigConfig
from collect.errors import ConfigError
from collect.procedures import check_all
from collect.protocol import plan_grid
from collect.rig import limits_of
from collect.sheet import Sheet
from drivers.errors import LimitExceeded


def check_plan(rig_path: Path, protocol_path: Path, rig: RigConfig, protocol: GridConfig) -> None:
    """Raise `ConfigError` naming file, field and range for the first thing that cannot be done."""
    brush = rig.brush
    for height_mm in protocol.heights_mm:
        if height_mm > brush.max_depth_mm:
            raise ConfigError(
                protocol_path,
                "heights_mm",
                f"{height_mm:g} mm is deeper than brush.max_depth_mm = {brush.max_depth_mm:g} mm allows",
            )
    sheet = Sheet(rig.paper)
    if sheet.capacity == 0:
        raise ConfigError(rig_path, "paper.cell_mm", f"{rig.paper.cell_mm} does not fit on {rig.paper.size_mm}")
    presses = {(stroke.height_mm, stroke.tilt_deg) for stroke in plan_grid(protocol)}
    cells = [sheet.cell(index) for index in range(sheet.capacity)]
    try:
        check_all(rig, limits_of(rig), cells, presses)
    except LimitExceeded as error:
        raise ConfigError(rig_path, "robot.limits", f"a planned pose has {error.what}") from None
