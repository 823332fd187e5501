"""Whether the values of a `rig.toml` are plausible, contradict each other, or were never measured. Asks no device.

`brushloop rig check` goes over a file; the first day checks single values as soon as they are taught.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rich.text import Text

from brushloop.calibrate.board.spec import size_mm
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.config_devices import CameraConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import Sheet, to_paper
from brushloop.collect.rig.places import Place, places_of

Span = tuple[float, float]
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

    def as_json(self) -> dict[str, Any]:
        """Every field."""
        return asdict(self)


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
    return [
        *_tool(config),
        *_camera(config.camera),
        *_sheet(config),
        *_ink(config),
        *_places(config),
        *_motion(config),
        *_force(config),
    ]


def contradictions(checks: list[Check]) -> int:
    """Number of checks that found a contradiction."""
    return sum(check.verdict == "contradicts" for check in checks)


def _tool(config: RigConfig) -> Iterator[Check]:
    offset_mm, brush, kg = config.robot.tcp_offset_mm, config.brush, config.robot.payload_kg
    tool_mm = math.hypot(*offset_mm)
    remedy = _metres(tool_mm, "Type millimetres, or teach the tip.") or "Teach the tip again: brushloop rig teach tip."
    yield within("tool length", tool_mm, *TOOL_MM, "mm", remedy)
    yield brush_square(config.robot.tcp_rotation_deg)
    yield brush_shorter_than_tool(offset_mm, brush.length_mm)
    yield deepest_press(brush.max_depth_mm, brush.length_mm)
    if kg:
        yield within("payload", kg, 0.05, 5.0, "kg", "Weigh holder, brush and sensor; an i5 carries 5 kg.")
    else:
        value = "the pendant's" if kg is None else "0 kg: never set"
        yield unmeasured("payload", value, "Weigh holder, brush and sensor: robot.payload_kg.")
    if config.robot.collision_level is None:
        yield unmeasured("collision level", "the pendant's", "robot.collision_level fixes it; 9 is the most sensitive.")


def _metres(length: float, remedy: str) -> str:
    """What to do where a length was probably typed in metres; empty for any other."""
    said = f"This looks like metres: {length:g} m are {1e3 * length:.0f} mm. {remedy}".rstrip()
    return said if 0.0 < length < METRES else ""


def _camera(camera: CameraConfig) -> Iterator[Check]:
    locked = camera.locked
    names = [name for name, value in locked.model_dump().items() if value is None]
    if "://" in camera.source:
        remedy = "Switch automatic exposure, white balance and focus off there."
        yield unmeasured("camera settings", "set by the stream's server", remedy)
    elif names:
        remedy = "Settings that are not locked may drift during a session: brushloop rig teach camera."
        yield unmeasured("camera settings", f"not locked: {', '.join(names)}", remedy)
    if camera.optics is None:
        remedy = "brushloop camera intrinsics makes camera.lens_file."
        yield unmeasured("lens", "not calibrated", remedy)
        return
    size, set_to = camera.optics.size_px, (locked.width, locked.height)
    agrees = set_to == (None, None) or set_to == size
    remedy = "" if agrees else "Calibrate the lens at the size that camera.locked asks for."
    verdict = "plausible" if agrees else "contradicts"
    yield Check("lens", verdict, f"calibrated at {size[0]} x {size[1]} px", "the size in camera.locked", remedy)


def _sheet(config: RigConfig) -> Iterator[Check]:
    paper, board, touch = config.paper, config.board, config.touch
    measure = "Measure ten squares of the print with calipers and divide by ten."
    yield within("square of the board", board.square_mm, 3.0, 60.0, "mm", _metres(board.square_mm, "") or measure)
    # Corners must be seen on all sides of the sheet.
    far_mm = [o + s - p for o, s, p in zip(board.origin_mm, size_mm(board), paper.size_mm, strict=True)]
    rim_mm = min(*(-o for o in board.origin_mm), *far_mm)
    remedy = "The sheet lies in the middle of a board that is larger than it: print a larger one, or teach the sheet."
    yield within("board around the sheet", rim_mm, 8.0, math.inf, "mm", remedy)
    patches = Sheet(paper).capacity
    yield within("patches on a sheet", patches, 1, math.inf, "", "paper.cell_mm does not fit on paper.size_mm.")
    points = len(touch.points_mm) or 1
    if touch.method == "taught":
        yield unmeasured(
            "height of the paper", "taught by hand", "Touch three points by force, camera or jog: [touch]."
        )
    elif points < 3:
        remedy = "Three touch.points_mm far apart would give the slope of the sheet."
        yield unmeasured("slope of the sheet", f"{points} touch points: taken as level", remedy)
    else:
        value = f"measured by {touch.method} at {points} points"
        yield Check("height of the paper", "plausible", value, "3 or more points")
    if config.self_check.enabled is False:
        remedy = "Three marks before a session show a mirrored or turned sheet: [self_check] enabled."
        yield unmeasured("self-check", "switched off", remedy)


def _ink(config: RigConfig) -> Iterator[Check]:
    ink, motion = config.ink, config.motion
    # A well stands on the same table as the sheet.
    remedy = "The bottom of a dip is far from the table: teach the well again."
    yield within("dip above the paper", ink.dip_z_mm - config.paper.touch_z_mm, -60.0, 120.0, "mm", remedy)
    if ink.wipe is not None:
        remedy = "Raise motion.safe_z_mm: a drop, or a tip bent by its ink, would catch the rim."
        yield within("travel above the rim", motion.safe_z_mm - ink.wipe.z_mm, 15.0, math.inf, "mm", remedy)
    else:
        yield unmeasured("rim of the well", "no [ink.wipe]", "The height of the rim is unknown: travel must clear it.")


def _places(config: RigConfig) -> Iterator[Check]:
    limits, places, board = limits_of(config), places_of(config), config.board
    box_mm = (limits.x_mm, limits.y_mm, limits.z_mm)
    yield from _in_box(places, box_mm)
    ends = [end for place in places for end in _ends(place)]
    room_mm = max(
        max(min(along) - low, high - max(along))
        for along, (low, high) in zip(zip(*ends, strict=True), box_mm, strict=True)
    )
    remedy = "The box should enclose what was taught and little more: brushloop rig teach limits."
    yield within("room in the box", room_mm, 0.0, LOOSE_MM, "mm", remedy)
    park_mm = to_paper(config.paper, *config.motion.park_mm[:2])
    sides = zip(park_mm, board.origin_mm, size_mm(board), strict=True)
    outside_mm = [max(low - at, at - low - size, 0.0) for at, low, size in sides]
    remedy = "The parked arm stands over the board, in the picture: brushloop rig teach places."
    yield within("park beside the board", math.hypot(*outside_mm), PARK_CLEAR_MM, math.inf, "mm", remedy)


def _in_box(places: Sequence[Place], box_mm: tuple[Span, Span, Span]) -> list[Check]:
    """The places outside the box of limits; if there is none, the one with the least margin, as one check of all."""
    inside_mm = {
        place.name: min(
            min(v - low, high - v) for end in _ends(place) for v, (low, high) in zip(end, box_mm, strict=True)
        )
        for place in places
    }
    remedy = "Outside the box of limits: brushloop rig teach limits, or correct the place."
    checks = {
        name: within(f"inside the box, {name}", margin_mm, 0.0, math.inf, "mm", remedy)
        for name, margin_mm in inside_mm.items()
    }
    if wrong := [check for check in checks.values() if check.verdict == "contradicts"]:
        return wrong
    worst = min(inside_mm, key=inside_mm.__getitem__)
    value = f"{checks[worst].value}, {worst}"
    return [dataclasses.replace(checks[worst], name=f"inside the box, {len(places)} places", value=value)]


def _ends(place: Place) -> tuple[tuple[float, float, float], ...]:
    """Lowest and highest point of the tip at a place, in the base frame."""
    x_mm, y_mm, _ = place.at_mm
    return place.at_mm, (x_mm, y_mm, place.top_mm)


def _motion(config: RigConfig) -> Iterator[Check]:
    limits, motion = limits_of(config), config.motion
    remedy = "The driver refuses every move at this speed: change it, or [robot.limits]."
    for name, value, most, unit in (
        ("travel speed", motion.travel_speed_mm_s, limits.speed_mm_s, "mm/s"),
        ("press speed", motion.press_speed_mm_s, limits.speed_mm_s, "mm/s"),
        ("touch speed", config.touch.speed_mm_s, limits.speed_mm_s, "mm/s"),
        ("acceleration", motion.acc_mm_s2, limits.acc_mm_s2, "mm/s2"),
    ):
        yield within(name, value, 0.1 if unit == "mm/s" else 1.0, most, unit, remedy)


def _force(config: RigConfig) -> Iterator[Check]:
    if config.force is None:
        yield unmeasured("force", "no sensor", "Only the arm itself stops a press that meets something hard.")
        return
    remedy = "A soft brush pushes with less than 3 N when it is pressed flat: force.max_n."
    yield within("force ceiling", config.force.max_n, 0.2, 30.0, "N", remedy)
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
