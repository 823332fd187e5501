"""What a `rig.toml` says: where the tip goes, as a table and a picture from above, and whether its values can be true.

`brushloop rig show` and `rig check` ask no device. The first day checks single values as soon as they are taught, and
plans draw their sheets beside the same picture.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.table import Table
from rich.text import Text

from brushloop.calibrate.board.spec import size_mm
from brushloop.calibrate.report import picture_grid
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import to_base, to_paper

Axes = Any
"""Axes of matplotlib, whose types are incomplete."""
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
"""From the palette of Okabe and Ito, which colour-blind people can tell apart; the marks differ in shape too."""
PAPER = "#fbf7ea"
MARKS = {
    "well": ("o", BLUE),
    "wipe, over the rim": ("v", BLUE),
    "wash pot": ("s", BLUE),
    "park": ("^", GREEN),
    "touch point": ("x", ORANGE),
}
"""Marker and colour of each kind of place; the sheet is drawn as an area."""
Verdict = Literal["plausible", "contradicts", "not measured"]
COLOURS: dict[Verdict, str] = {"plausible": "green", "contradicts": "red", "not measured": "yellow"}


def places_of(config: RigConfig) -> dict[str, tuple[float, float, float]]:
    """Where the tip of the upright brush goes, by name: in the base frame, z its lowest height there, in mm."""
    paper, ink = config.paper, config.ink
    deepest_mm = paper.touch_z_mm - config.brush.max_depth_mm
    width, height = paper.size_mm
    on_paper_mm = {
        "sheet lower left, deepest press": (0.0, 0.0, deepest_mm),
        "sheet lower right, deepest press": (width, 0.0, deepest_mm),
        "sheet upper right, deepest press": (width, height, deepest_mm),
        "sheet upper left, deepest press": (0.0, height, deepest_mm),
        "well": (*ink.well_mm, ink.dip_z_mm),
    }
    if ink.wipe is not None:
        on_paper_mm["wipe, over the rim"] = (*ink.wipe.rim_mm, ink.wipe.z_mm)
    if ink.wash is not None:
        on_paper_mm["wash pot"] = (*ink.wash.pot_mm, ink.wash.dip_z_mm)
    for number, point_mm in enumerate(config.touch.points_mm or [paper.touch_point_mm], 1):
        on_paper_mm[f"touch point {number}"] = (*point_mm, paper.touch_z_mm)
    in_base_mm = {name: (*to_base(paper, x_mm, y_mm), z_mm) for name, (x_mm, y_mm, z_mm) in on_paper_mm.items()}
    return in_base_mm | {"park": config.motion.park_mm}


def rig_table(config: RigConfig) -> Table:
    """A place a row, in the frames of the base and of the paper, in mm; then two corners of the box of limits."""
    limits = config.robot.limits
    table = Table("place", "base x", "y", "z", "paper x", "y", title=f"{config.name}: mm")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, at_mm in places_of(config).items():
        table.add_row(name, *(f"{v:.1f}" for v in (*at_mm, *to_paper(config.paper, *at_mm[:2]))))
    for end, *corner in zip(("lowest", "highest"), limits.x_mm, limits.y_mm, limits.z_mm, strict=True):
        table.add_row(f"box, {end}", *(f"{v:.1f}" for v in corner))
    return table


# The picture from above


def draw_rig(config: RigConfig, path: Path) -> None:
    """Write the picture, in the format of the file's ending. Raises OSError if it cannot be written."""
    picture, [[above]] = picture_grid(1, 1, (7.2, 6.4), f"{config.name}: base frame, mm")
    from_above(above, config)
    picture.legend(loc="outside lower center", ncols=4, frameon=False)
    picture.savefig(path)


def from_above(axes: Axes, config: RigConfig) -> None:
    """Everything that stands on the table, and the box of limits."""
    limits, paper, board, places = limits_of(config), config.paper, config.board, places_of(config)
    axes.plot(0.0, 0.0, "+", color="black", markersize=14, mew=2.0, label="base of the arm")
    (left, right), (low, high) = limits.x_mm, limits.y_mm
    box, turned = (left, low, right - left, high - low), {"angle": paper.yaw_deg}
    outline(axes, box, label="box of limits", fill=False, edgecolor=ORANGE, linewidth=1.6)
    beneath = (*to_base(paper, *board.origin_mm), *size_mm(board))
    outline(axes, beneath, label="board", fill=False, edgecolor=GREY, linestyle="--", **turned)
    outline(axes, (*paper.origin_mm, *paper.size_mm), label="sheet", facecolor=PAPER, edgecolor="black", **turned)
    for name, tip in (("x", (40.0, 0.0)), ("y", (0.0, 40.0))):
        axes.annotate("", to_base(paper, *tip), paper.origin_mm, arrowprops={"arrowstyle": "->", "color": "black"})
        axes.annotate(name, to_base(paper, *(1.25 * v for v in tip)), ha="center", va="center", fontsize=9)
    for kind, (marker, colour) in MARKS.items():
        at = [at_mm[:2] for name, at_mm in places.items() if name.startswith(kind)]
        if at:
            axes.plot(*zip(*at, strict=True), marker, color=colour, markersize=9, mew=2.0, linestyle="none", label=kind)
    axes.margins(0.1)
    finish(axes, "from above", ("base x mm", "base y mm"))


def outline(axes: Axes, rect_mm: tuple[float, float, float, float], **style: Any) -> None:
    """Draw a rectangle by its lower left corner, width and height; `style` is matplotlib's."""
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle(rect_mm[:2], *rect_mm[2:], **style))


def finish(axes: Axes, title: str, along: tuple[str, str] = ("x mm", "y mm")) -> None:
    """Equal scales, a title, and labels that say what runs `along` the axes."""
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(along[0], fontsize=8)
    axes.set_ylabel(along[1], fontsize=8)
    axes.tick_params(labelsize=8)


# What can be true


@dataclass(frozen=True, slots=True)
class Check:
    """One value, the range that it may have, and what to do where it lies outside."""

    name: str
    verdict: Verdict
    value: str
    allowed: str = ""
    remedy: str = ""
    """Empty for what is plausible."""


def within(name: str, value: float, low: float, high: float, unit: str, remedy: str) -> Check:
    """A number that must lie in [low, high]; an infinite `high` is no limit."""
    allowed = f"{low:g} {unit} or more" if math.isinf(high) else f"{low:g} to {high:g} {unit}"
    good = low <= value <= high
    return Check(name, "plausible" if good else "contradicts", f"{value:.1f} {unit}", allowed, "" if good else remedy)


def unmeasured(name: str, value: str, remedy: str) -> Check:
    """A value that nothing on this rig has measured."""
    return Check(name, "not measured", value, remedy=remedy)


def tool_length(offset_mm: Sequence[float]) -> Check:
    """Distance from the flange to the tip of the brush."""
    tool_mm = math.hypot(*offset_mm)
    return within("tool length", tool_mm, 40.0, 500.0, "mm", _metres(tool_mm) or "brushloop rig teach tip.")


def brush_square(rotation_deg: tuple[float, float, float]) -> Check:
    """Angle between the flange's axis and the brush's: a holder is not far from square to the flange.

    No measurement gives exactly zero: there the brush was only taken as square.
    """
    if not any(rotation_deg):
        remedy = "Measure it with the brush held upright: brushloop rig teach tip."
        return unmeasured("brush to the flange's axis", "assumed to be square", remedy)
    about_x, about_y, _ = map(math.radians, rotation_deg)
    lean_deg = math.degrees(math.acos(max(-1.0, min(1.0, math.cos(about_x) * math.cos(about_y)))))
    remedy = "The brush would lean far from the flange's axis. Look at the holder, and teach the tip again."
    return within("brush to the flange's axis", lean_deg, 0.0, 20.0, "deg", remedy)


def brush_shorter_than_tool(offset_mm: Sequence[float], length_mm: float) -> Check:
    """Length of the hair, which is a part of the tool."""
    remedy = "The hair is longer than the whole tool: measure brush.length_mm, or teach the tip."
    return within("hair of the brush", length_mm, 5.0, round(math.hypot(*offset_mm), 1), "mm", remedy)


def deepest_press(max_depth_mm: float, length_mm: float) -> Check:
    """The deepest press: beyond it the bundle is pressed flat, and its hairs break."""
    remedy = "Set brush.max_depth_mm within this range: deeper, the ferrule comes near the paper."
    return within("deepest press", max_depth_mm, 0.5, round(0.6 * length_mm, 1), "mm", remedy)


def check_rig(config: RigConfig) -> list[Check]:
    """Every value that must lie within a range, then what was not measured.

    What a protocol needs of the rig (speeds, poses, room on the sheet) is checked with the protocol.
    """
    return [*_tool_and_sheet(config), *_places(config), *_not_measured(config)]


def _tool_and_sheet(config: RigConfig) -> Iterator[Check]:
    robot, brush, board, force = config.robot, config.brush, config.board, config.force
    yield tool_length(robot.tcp_offset_mm)
    yield brush_square(robot.tcp_rotation_deg)
    yield brush_shorter_than_tool(robot.tcp_offset_mm, brush.length_mm)
    yield deepest_press(brush.max_depth_mm, brush.length_mm)
    measure = _metres(board.square_mm) or "Measure ten squares of the print with calipers and divide by ten."
    yield within("square of the board", board.square_mm, 3.0, 60.0, "mm", measure)
    # Corners must be seen on all sides of the sheet.
    far_mm = [o + s - p for o, s, p in zip(board.origin_mm, size_mm(board), config.paper.size_mm, strict=True)]
    rim_mm = min(*(-o for o in board.origin_mm), *far_mm)
    remedy = "The board must show on all sides of the sheet: print a larger board, or teach the sheet again."
    yield within("board around the sheet", rim_mm, 8.0, math.inf, "mm", remedy)
    if force is not None:
        remedy = "Set force.max_n: a soft brush that is pressed flat pushes with less than 3 N."
        yield within("force ceiling", force.max_n, 0.2, 30.0, "N", remedy)


def _metres(length: float) -> str:
    """What to say of a length that was probably typed in metres; empty for any other."""
    looks = f"This looks like metres: {length:g} m are {1e3 * length:.0f} mm. Type millimetres."
    return looks if 0.0 < length < 1.5 else ""


def _places(config: RigConfig) -> Iterator[Check]:
    ink, motion, limits, board = config.ink, config.motion, limits_of(config), config.board
    # A well stands on the same table as the sheet.
    remedy = "The bottom of a dip is far from the table: teach the well again."
    yield within("dip above the paper", ink.dip_z_mm - config.paper.touch_z_mm, -60.0, 120.0, "mm", remedy)
    if ink.wipe is not None:
        remedy = "Raise motion.safe_z_mm: a drop, or a tip bent by its ink, would catch the rim."
        yield within("travel above the rim", motion.safe_z_mm - ink.wipe.z_mm, 15.0, math.inf, "mm", remedy)
    places = places_of(config)
    box_low, box_high = np.array((limits.x_mm, limits.y_mm, limits.z_mm)).T
    lowest_mm = np.array([*places.values()])
    highest_mm = np.maximum(lowest_mm, (-math.inf, -math.inf, motion.safe_z_mm))
    margins_mm = np.minimum(lowest_mm - box_low, box_high - highest_mm).min(axis=1)
    outside = np.flatnonzero(margins_mm < 0.0)
    remedy = "Outside the box of limits: brushloop rig teach limits, or correct the place."
    for at in outside if outside.size else [margins_mm.argmin()]:
        yield within(f"inside the box, {list(places)[at]}", float(margins_mm[at]), 0.0, math.inf, "mm", remedy)
    room_mm = np.maximum(lowest_mm.min(axis=0) - box_low, box_high - highest_mm.max(axis=0)).max()
    remedy = "The box should enclose what was taught and little more: brushloop rig teach limits."
    yield within("room in the box", float(room_mm), 0.0, 250.0, "mm", remedy)
    sides = zip(to_paper(config.paper, *motion.park_mm[:2]), board.origin_mm, size_mm(board), strict=True)
    outside_mm = math.hypot(*(max(low - at, at - low - size, 0.0) for at, low, size in sides))
    # Half the width of a holder and a part of the wrist must be out of the picture.
    remedy = "The parked arm stands over the board, in the picture: brushloop rig teach places."
    yield within("park beside the board", outside_mm, 40.0, math.inf, "mm", remedy)


def _not_measured(config: RigConfig) -> Iterator[Check]:
    robot, camera, touch = config.robot, config.camera, config.touch
    if not robot.payload_kg:
        yield unmeasured("payload", "the pendant's", "Weigh holder, brush and sensor, and set robot.payload_kg.")
    if robot.collision_level is None:
        yield unmeasured("collision level", "the pendant's", "Set robot.collision_level; 9 is the most sensitive.")
    if unlocked := [name for name, value in camera.locked.model_dump().items() if value is None]:
        remedy = "Unlocked settings may drift: set camera.locked, or lock them in the program that serves the stream."
        yield unmeasured("camera settings", f"not locked: {', '.join(unlocked)}", remedy)
    if camera.optics is None:
        yield unmeasured("lens", "not calibrated", "brushloop camera intrinsics makes camera.lens_file.")
    if touch.method == "taught" or len(touch.points_mm) < 3:
        value = "taught by hand" if touch.method == "taught" else "fewer than three touch points: assumed level"
        yield unmeasured("height and slope of the paper", value, "Set [touch] to three or more points, far apart.")
    if config.self_check.enabled is False:
        remedy = "Enable [self_check]: three marks before a session show a mirrored or turned sheet."
        yield unmeasured("self-check", "switched off", remedy)
    if config.ink.wipe is None:
        yield unmeasured("rim of the well", "no [ink.wipe]", "Travel must clear the rim, whose height is unknown.")
    if config.force is None:
        yield unmeasured("force", "no sensor", "Only the arm itself stops a press that meets something hard.")


def check_page(checks: list[Check]) -> Text:
    """A line for each check, with its verdict as a word and a colour, followed by what to do, if anything."""
    page, width = Text(), max(len(check.name) for check in checks)
    for check in checks:
        page.append(f"{check.verdict:<12}", COLOURS[check.verdict])
        allowed = f"  ({check.allowed})" if check.allowed else ""
        page.append(f"  {check.name:<{width}}  {check.value}{allowed}\n")
        if check.remedy:
            page.append(f"{'':14}{check.remedy}\n", "dim")
    counts = Counter(check.verdict for check in checks)
    plausible, contradicting, unknown = (counts[verdict] for verdict in COLOURS)
    page.append(f"{plausible} values are plausible, {contradicting} contradict others, {unknown} were not measured")
    return page
