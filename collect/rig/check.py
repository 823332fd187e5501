"""Whether the values of a `rig.toml` are plausible, contradict each other, or were never measured. Asks no device.

`brushloop rig check` goes over a file; the first day checks single values as soon as they are taught.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from rich.text import Text

from brushloop.calibrate.board.spec import size_mm
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import Sheet, to_paper
from brushloop.collect.rig.show import places_of

Verdict = Literal["plausible", "contradicts", "not measured"]
COLOURS: dict[Verdict, str] = {"plausible": "green", "contradicts": "red", "not measured": "yellow"}
TOOL_MM = (40.0, 500.0)
"""Lengths from flange to tip that a holder and a brush have, with or without a force sensor."""
METRES = 1.5
"""An offset or a square shorter than this was probably typed in metres, as the pendant shows it."""
LOOSE_MM = 250.0
"""Room beyond the outermost place, in mm, from which on the box no longer protects anything."""
PARK_CLEAR_MM = 40.0
"""Half the width of a holder and a part of the wrist, which must be out of the picture."""


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
    unit = f" {unit}" if unit else ""
    allowed = f"{low:g}{unit} or more" if math.isinf(high) else f"{low:g} to {high:g}{unit}"
    shown = f"{value:.{0 if isinstance(value, int) else 1}f}{unit}"
    good = low <= value <= high
    return Check(name, "plausible" if good else "contradicts", shown, allowed, "" if good else remedy)


def unmeasured(name: str, value: str, remedy: str) -> Check:
    """A value that nothing on this rig has measured."""
    return Check(name, "not measured", value, remedy=remedy)


def brush_square(rotation_deg: tuple[float, float, float]) -> Check:
    """Angle between the flange's axis and the brush's: a holder is not far from square to the flange.

    No measurement gives exactly zero: there the brush was only taken as square.
    """
    if not any(rotation_deg):
        remedy = "Hold the brush upright: brushloop rig teach tip."
        return unmeasured("brush to the flange's axis", "taken as square", remedy)
    about_x, about_y, _ = map(math.radians, rotation_deg)
    lean_deg = math.degrees(math.acos(max(-1.0, min(1.0, math.cos(about_x) * math.cos(about_y)))))
    remedy = "The brush would lean far from the flange's axis. Look at the holder, and teach the tip again."
    return within("brush to the flange's axis", lean_deg, 0.0, 20.0, "deg", remedy)


def brush_shorter_than_tool(offset_mm: tuple[float, float, float], length_mm: float) -> Check:
    """Length of the hair, which is a part of the tool."""
    remedy = "The hair is longer than the whole tool: measure brush.length_mm, or teach the tip."
    return within("hair of the brush", length_mm, 5.0, round(math.hypot(*offset_mm), 1), "mm", remedy)


def deepest_press(max_depth_mm: float, length_mm: float) -> Check:
    """The deepest press: beyond it the bundle is pressed flat, and its hairs break."""
    remedy = "Give brush.max_depth_mm a smaller value: the ferrule would come near the paper."
    return within("deepest press", max_depth_mm, 0.5, round(0.6 * length_mm, 1), "mm", remedy)


def check_rig(config: RigConfig) -> list[Check]:
    """Every check, in the order in which the first day teaches the values."""
    return [*_tool(config), *_camera_and_sheet(config), *_places(config), *_motion_and_force(config)]


def contradictions(checks: list[Check]) -> int:
    """Number of checks that found a contradiction."""
    return sum(check.verdict == "contradicts" for check in checks)


def _tool(config: RigConfig) -> Iterator[Check]:
    robot, brush = config.robot, config.brush
    tool_mm = math.hypot(*robot.tcp_offset_mm)
    yield within("tool length", tool_mm, *TOOL_MM, "mm", _metres(tool_mm) or "brushloop rig teach tip.")
    yield brush_square(robot.tcp_rotation_deg)
    yield brush_shorter_than_tool(robot.tcp_offset_mm, brush.length_mm)
    yield deepest_press(brush.max_depth_mm, brush.length_mm)
    if robot.payload_kg:
        yield within("payload", robot.payload_kg, 0.05, 5.0, "kg", "Weigh holder, brush and sensor.")
    else:
        value = "the pendant's" if robot.payload_kg is None else "0 kg: never set"
        yield unmeasured("payload", value, "Weigh holder, brush and sensor: robot.payload_kg.")
    if robot.collision_level is None:
        yield unmeasured("collision level", "the pendant's", "robot.collision_level fixes it; 9 is the most sensitive.")


def _metres(length: float) -> str:
    """What to say of a length that was probably typed in metres; empty for any other."""
    looks = f"This looks like metres: {length:g} m are {1e3 * length:.0f} mm. Type millimetres."
    return looks if 0.0 < length < METRES else ""


def _camera_and_sheet(config: RigConfig) -> Iterator[Check]:
    camera, paper, board, touch = config.camera, config.paper, config.board, config.touch
    unlocked = [name for name, value in camera.locked.model_dump().items() if value is None]
    if unlocked:
        stream = "://" in camera.source
        value = "set by the stream's server" if stream else f"not locked: {', '.join(unlocked)}"
        remedy = "Switch automatic exposure, white balance and focus off there." if stream else "They may drift."
        yield unmeasured("camera settings", value, remedy)
    if camera.optics is None:
        yield unmeasured("lens", "not calibrated", "brushloop camera intrinsics makes camera.lens_file.")
    elif (set_to := (camera.locked.width, camera.locked.height)) not in ((None, None), camera.optics.size_px):
        value = "calibrated at {} x {} px".format(*camera.optics.size_px)
        yield Check("lens", "contradicts", value, "{} x {} px".format(*set_to), "Calibrate it at camera.locked's size.")
    measure = _metres(board.square_mm) or "Measure ten squares of the print with calipers and divide by ten."
    yield within("square of the board", board.square_mm, 3.0, 60.0, "mm", measure)
    # Corners must be seen on all sides of the sheet.
    far_mm = [o + s - p for o, s, p in zip(board.origin_mm, size_mm(board), paper.size_mm, strict=True)]
    rim_mm = min(*(-o for o in board.origin_mm), *far_mm)
    remedy = "The sheet lies in the middle of a board that is larger than it: print a larger one, or teach the sheet."
    yield within("board around the sheet", rim_mm, 8.0, math.inf, "mm", remedy)
    patches = Sheet(paper).capacity
    yield within("patches on a sheet", patches, 1, math.inf, "", "paper.cell_mm does not fit on paper.size_mm.")
    points = len(touch.points_mm) or 1
    if touch.method == "taught" or points < 3:
        value = "taught by hand" if touch.method == "taught" else f"{points} touch points: taken as level"
        yield unmeasured("height and slope of the paper", value, "Touch three points or more far apart: [touch].")
    if config.self_check.enabled is False:
        remedy = "Three marks before a session show a mirrored or turned sheet: [self_check] enabled."
        yield unmeasured("self-check", "switched off", remedy)


def _places(config: RigConfig) -> Iterator[Check]:
    ink, motion, limits, board = config.ink, config.motion, limits_of(config), config.board
    # A well stands on the same table as the sheet.
    remedy = "The bottom of a dip is far from the table: teach the well again."
    yield within("dip above the paper", ink.dip_z_mm - config.paper.touch_z_mm, -60.0, 120.0, "mm", remedy)
    if ink.wipe is None:
        yield unmeasured("rim of the well", "no [ink.wipe]", "The height of the rim is unknown: travel must clear it.")
    else:
        remedy = "Raise motion.safe_z_mm: a drop, or a tip bent by its ink, would catch the rim."
        yield within("travel above the rim", motion.safe_z_mm - ink.wipe.z_mm, 15.0, math.inf, "mm", remedy)
    box_mm, places = (limits.x_mm, limits.y_mm, limits.z_mm), places_of(config)
    ends = {place.name: (place.at_mm, (*place.at_mm[:2], place.top_mm)) for place in places}
    remedy = "Outside the box of limits: brushloop rig teach limits, or correct the place."
    inside: list[Check] = []
    for name, both in ends.items():
        margin_mm = min(min(v - low, high - v) for end in both for v, (low, high) in zip(end, box_mm, strict=True))
        inside.append(within(f"inside the box, {name}", margin_mm, 0.0, math.inf, "mm", remedy))
    wrong = [check for check in inside if check.verdict == "contradicts"]
    yield from wrong or [dataclasses.replace(inside[0], name=f"inside the box, {len(places)} places", value="all")]
    along = zip(*(end for both in ends.values() for end in both), strict=True)
    room_mm = max(max(min(v) - low, high - max(v)) for v, (low, high) in zip(along, box_mm, strict=True))
    remedy = "The box should enclose what was taught and little more: brushloop rig teach limits."
    yield within("room in the box", room_mm, 0.0, LOOSE_MM, "mm", remedy)
    sides = zip(to_paper(config.paper, *motion.park_mm[:2]), board.origin_mm, size_mm(board), strict=True)
    outside_mm = math.hypot(*(max(low - at, at - low - size, 0.0) for at, low, size in sides))
    remedy = "The parked arm stands over the board, in the picture: brushloop rig teach places."
    yield within("park beside the board", outside_mm, PARK_CLEAR_MM, math.inf, "mm", remedy)


def _motion_and_force(config: RigConfig) -> Iterator[Check]:
    limits, motion, force = limits_of(config), config.motion, config.force
    remedy = "The driver refuses every move at this speed: change it, or [robot.limits]."
    yield within("travel speed", motion.travel_speed_mm_s, 0.1, limits.speed_mm_s, "mm/s", remedy)
    yield within("press speed", motion.press_speed_mm_s, 0.1, limits.speed_mm_s, "mm/s", remedy)
    yield within("touch speed", config.touch.speed_mm_s, 0.1, limits.speed_mm_s, "mm/s", remedy)
    yield within("acceleration", motion.acc_mm_s2, 1.0, limits.acc_mm_s2, "mm/s2", remedy)
    if force is None:
        yield unmeasured("force", "no sensor", "Only the arm itself stops a press that meets something hard.")
        return
    remedy = "A soft brush pushes with less than 3 N when it is pressed flat: force.max_n."
    yield within("force ceiling", force.max_n, 0.2, 30.0, "N", remedy)
    if config.touch.method == "force":
        axis = config.touch.force.push_axis
        off_deg = math.degrees(math.acos(min(abs(axis[2]) / math.hypot(*axis), 1.0)))
        remedy = "The paper pushes along the tool: brushloop rig teach force finds axis and sign by a push."
        yield within("push axis", off_deg, 0.0, 20.0, "deg", remedy)


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
