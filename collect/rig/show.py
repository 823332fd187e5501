"""The rig as text: one row for each place, and the box, tool and speeds above it."""

from __future__ import annotations

from typing import Any

from rich.console import Group
from rich.table import Table

from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.places import places_of


def rig_table(config: RigConfig) -> Group:
    """What the rig is, then its places in the frames of the base and of the paper, in mm."""
    limits, motion, paper = limits_of(config), config.motion, config.paper
    about = Table(title=config.name, show_header=False)
    robot = config.robot
    turned = f", turned {_list(robot.tcp_rotation_deg)} deg" if any(robot.tcp_rotation_deg) else ""
    about.add_row("arm", f"{robot.host}:{robot.port}, tip at {_list(robot.tcp_offset_mm)} mm{turned}")
    about.add_row("brush", f"{config.brush.name}, pressed {config.brush.max_depth_mm:g} mm deep at most")
    about.add_row("sheet", f"{_by(paper.size_mm)} mm, yaw {paper.yaw_deg:.2f} deg, touched at z {paper.touch_z_mm:.2f}")
    about.add_row("board", f"{_by(config.board.squares)} squares of {config.board.square_mm:g} mm")
    for axis, (low, high) in (("x", limits.x_mm), ("y", limits.y_mm), ("z", limits.z_mm)):
        about.add_row(f"box, {axis}", f"{low:.1f} to {high:.1f} mm")
    about.add_row("tilt", f"at most {limits.tilt_deg:g} deg")
    about.add_row("speed", f"travel {motion.travel_speed_mm_s:g}, press {motion.press_speed_mm_s:g} mm/s")
    above_mm = motion.safe_z_mm - paper.touch_z_mm
    about.add_row("travel height", f"{motion.safe_z_mm:.1f} mm, {above_mm:.1f} mm above the paper")
    table = Table("place", "base x", "y", "z", "paper x", "y")
    for column in table.columns[1:]:
        column.justify = "right"
    for place in places_of(config):
        table.add_row(place.name, *(f"{v:.1f}" for v in (*place.at_mm, *place.paper_mm)))
    return Group(about, table)


def rig_json(config: RigConfig) -> dict[str, Any]:
    """The box, the cone and the places, in mm and deg."""
    limits = limits_of(config)
    return {
        "name": config.name,
        "limits": {"x_mm": limits.x_mm, "y_mm": limits.y_mm, "z_mm": limits.z_mm, "tilt_deg": limits.tilt_deg},
        "places": [{"name": p.name, "at_mm": p.at_mm, "paper_mm": p.paper_mm} for p in places_of(config)],
    }


def _list(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{v:.1f}" for v in values) + ")"


def _by(values: tuple[float, float]) -> str:
    return f"{values[0]:g} x {values[1]:g}"
