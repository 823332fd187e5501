"""Walks a protocol without moving: every pose against the limits, before anything is connected."""

from __future__ import annotations

import math
from pathlib import Path

from collect.config import GridConfig, RigConfig
from collect.errors import ConfigError
from collect.procedures import check_all
from collect.protocol import plan_grid
from collect.rig import limits_of
from collect.sheet import Sheet
from drivers.errors import LimitExceeded

TOUCH_CLEAR_MM = 5.0


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
        for tilt_deg in protocol.tilts_deg:
            most_mm = brush.length_mm * math.cos(math.radians(tilt_deg))
            if height_mm > most_mm:
                raise ConfigError(
                    protocol_path,
                    "heights_mm",
                    f"{height_mm:g} mm at {tilt_deg:g} deg is more than the bundle is long ({most_mm:.1f} mm)",
                )
    sheet = Sheet(rig.paper)
    if sheet.capacity == 0:
        raise ConfigError(rig_path, "paper.cell_mm", f"{rig.paper.cell_mm} does not fit on {rig.paper.size_mm}")
    presses = {(stroke.height_mm, stroke.tilt_deg) for stroke in plan_grid(protocol)}
    cells = [sheet.cell(index) for index in range(sheet.capacity)]
    for cell in cells:
        if math.dist(cell.anchor_mm, rig.paper.touch_point_mm) < TOUCH_CLEAR_MM:
            raise ConfigError(
                rig_path,
                "paper.touch_point_mm",
                f"{list(rig.paper.touch_point_mm)} lies within {TOUCH_CLEAR_MM:g} mm of a press at "
                f"{[round(v, 1) for v in cell.anchor_mm]}",
            )
    try:
        check_all(rig, limits_of(rig), cells, presses)
    except LimitExceeded as error:
        raise ConfigError(rig_path, "robot.limits", f"a planned pose leaves them: {error.what}") from None
