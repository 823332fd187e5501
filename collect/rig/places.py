"""The places that the tip goes to, by name, in the base frame: what a picture shows and a check goes over.

Also the rig as text.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from rich.console import Group
from rich.table import Table

from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import to_base, to_paper

Kind = Literal["sheet", "touch", "well", "rim", "pot", "park"]


@dataclass(frozen=True, slots=True)
class Place:
    """Where the tip of the upright brush goes."""

    kind: Kind
    name: str
    at_mm: tuple[float, float, float]
    """In the base frame; z is the lowest height of the tip there."""
    paper_mm: tuple[float, float]
    """The same point in the paper frame, seen from above."""
    top_mm: float
    """Height in the base frame from which the tip comes down to it."""


def places_of(config: RigConfig) -> tuple[Place, ...]:
    """Every place of `rig.toml`, the corners of the sheet first."""
    paper, ink, safe_z_mm = config.paper, config.ink, config.motion.safe_z_mm
    width, height = paper.size_mm
    corners = {
        "sheet lower left": (0.0, 0.0),
        "sheet lower right": (width, 0.0),
        "sheet upper right": (width, height),
        "sheet upper left": (0.0, height),
    }
    deepest_mm = paper.touch_z_mm - config.brush.max_depth_mm
    places = [_over(config, "sheet", name, at, deepest_mm) for name, at in corners.items()]
    places.append(_over(config, "well", "well", ink.well_mm, ink.dip_z_mm))
    if ink.wipe is not None:
        places.append(_over(config, "rim", "wipe, over the rim", ink.wipe.rim_mm, ink.wipe.z_mm))
    if ink.wash is not None:
        places.append(_over(config, "pot", "wash pot", ink.wash.pot_mm, ink.wash.dip_z_mm))
    park = config.motion.park_mm
    at = to_paper(paper, park[0], park[1])
    places.append(Place("park", "park", park, at, max(park[2], safe_z_mm)))
    touched = config.touch.points_mm or [paper.touch_point_mm]
    places += [
        _over(config, "touch", f"touch point {number}", point, paper.touch_z_mm)
        for number, point in enumerate(touched, 1)
    ]
    return tuple(places)


def _over(config: RigConfig, kind: Kind, name: str, paper_mm: tuple[float, float], z_mm: float) -> Place:
    at_mm = (*to_base(config.paper, *paper_mm), z_mm)
    return Place(kind, name, at_mm, paper_mm, config.motion.safe_z_mm)


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
