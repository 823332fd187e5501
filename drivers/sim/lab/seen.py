"""What a person in an unknown lab can see and read, and the file with the truth, which only tests read."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from brushloop.drivers.sim.camera.scene import camera_matrix
from brushloop.drivers.sim.lab.facts import CORNERS, Facts, corner, in_base
from brushloop.drivers.sim.lab.traps import Trap
from brushloop.drivers.sim.world import tool_of

PRESS_SHARE = 0.45
"""Deepest press, as a share of the free length, that the maker of the brush allows."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Labels, plugs and print of one lab."""

    host: str
    """Address on the pendant's network page."""
    streams: tuple[str, ...]
    """Addresses on the stickers of the cameras."""
    can: tuple[str, int, str]
    """Host, port and bus of the CAN gateway with the force sensor."""
    ink: tuple[str, str] | None
    """Kind and serial line of the device at the well; None where a person pours."""
    squares: tuple[int, int]
    square_mm: float
    marker_mm: float
    dictionary: str
    radius_mm: float
    length_mm: float
    max_depth_mm: float

    def lines(self) -> list[str]:
        """For a person to read."""
        host, port, bus = self.can
        ink = "none, a person pours" if self.ink is None else f"{self.ink[0]} on {self.ink[1]}"
        return [
            "an unknown lab; simulated: nothing measured in it is a result on paper",
            f"robot     the pendant shows the address {self.host}",
            *(f"camera    {stream}" for stream in self.streams),
            f"force     SRI M8123 on the gateway {host}:{port}/{bus}",
            f"ink       {ink}",
            f"print     ChArUco, {self.squares[0]} x {self.squares[1]} squares of {self.square_mm:g} mm, "
            f"markers of {self.marker_mm:g} mm, {self.dictionary}",
            f"brush     radius R = {self.radius_mm:g} mm, length L = {self.length_mm:g} mm, "
            f"press at most {self.max_depth_mm:g} mm",
        ]


def truth(facts: Facts, trap: Trap | None) -> dict[str, Any]:
    """Everything that a first day should find, as JSON; lengths in mm, angles in deg, base frame unless named."""
    config, table, view = facts.config, facts.config.table, facts.config.view
    tool = tool_of(config)
    return {
        "seed": facts.seed,
        "trap": None if trap is None else trap.value,
        "tool": {
            "tcp_offset_mm": (1e3 * tool[:3, 3]).tolist(),
            "brush_axis": tool[:3, 2].tolist(),
            "lean_deg": float(np.degrees(np.arccos(min(1.0, tool[2, 2])))),
        },
        "paper": {
            "origin_mm": list(table.origin_mm),
            "yaw_deg": table.yaw_deg,
            "touch_z_mm": table.paper_z_mm,
            "normal": list(table.normal),
            "size_mm": list(table.sheet_mm),
            "corners_mm": {name: list(corner(table, "sheet", name)) for name in CORNERS},
        },
        "board": {
            "origin_mm": list(table.board_origin_mm),
            "square_mm": table.board_square_mm,
            "marker_mm": table.board_marker_mm,
            "corners_mm": {name: list(corner(table, "board", name)) for name in CORNERS},
        },
        "well": {
            "paper_mm": list(table.well_mm),
            "rim_mm": list(in_base(table, *table.well_mm, table.well_depth_mm)),
            "radius_mm": table.well_radius_mm,
            "bottom_z_mm": table.surface_z_mm(*table.well_mm),
        },
        "wash": {"paper_mm": list(facts.wash_mm)},
        "pin_mm": list(facts.pin_mm),
        "park_mm": list(facts.park_mm),
        "camera": {
            "stream": facts.sheet_camera,
            "delay_s": view.delay_s + 0.5 * view.delay_jitter_s,
            "fps": view.fps,
            "matrix": camera_matrix(view).tolist(),
            "k1": view.k1,
            "lens_mm": list(view.lens_mm or ()),
            "mirrored": view.mirrored,
        },
        "force": {"turn_deg": config.sensor_turn_deg, "sign": config.sensor_sign, "hanging_kg": config.hanging_kg},
        "brush": asdict(config.brush),
        "cabinet": {"tcp_offset": list(facts.cabinet_tcp), "payload_kg": facts.payload_kg},
    }
