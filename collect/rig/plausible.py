"""Checks whether single values of a rig are plausible: each function takes values of `rig.toml` and gives one line.

`brushloop rig check` runs all of them on a file, `brushloop rig new` runs each as soon as its value is taught.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from brushloop.collect.rig.places import Place

Span = tuple[float, float]
Box = tuple[Span, Span, Span]
"""Lower and upper end along x, y and z of the base frame, in mm."""
Verdict = Literal["plausible", "contradicts", "not measured"]


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


# The tool

TOOL_MM = (40.0, 500.0)
"""Lengths from flange to tip that a holder and a brush have, with or without a force sensor."""
METRES = 1.5
"""An offset or a square shorter than this was probably typed in metres, as the pendant shows it."""


def tool_length(offset_mm: tuple[float, float, float]) -> Check:
    """Distance from flange to tip."""
    length_mm = math.hypot(*offset_mm)
    in_metres = 0.0 < length_mm < METRES
    remedy = (
        f"This looks like metres: {length_mm:g} m are {1e3 * length_mm:.0f} mm. Type millimetres, or teach the tip."
        if in_metres
        else "Teach the tip again: brushloop rig teach tip."
    )
    return within("tool length", length_mm, *TOOL_MM, "mm", remedy)


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


def payload(kg: float | None) -> Check:
    """Mass at the flange, which the controller's collision detection relies on."""
    if not kg:
        value = "the pendant's" if kg is None else "0 kg: never set"
        return unmeasured("payload", value, "Weigh holder, brush and sensor: robot.payload_kg.")
    return within("payload", kg, 0.05, 5.0, "kg", "Weigh holder, brush and sensor; an i5 carries 5 kg.")


# Sheet and board


def square_size(square_mm: float) -> Check:
    """Side of a square of the printed board."""
    remedy = (
        f"This looks like metres: {square_mm:g} m are {1e3 * square_mm:.0f} mm."
        if square_mm < METRES
        else "Measure ten squares of the print with calipers and divide by ten."
    )
    return within("square of the board", square_mm, 3.0, 60.0, "mm", remedy)


def board_rim(board_mm: tuple[float, float], origin_mm: tuple[float, float], sheet_mm: tuple[float, float]) -> Check:
    """How far the board reaches beyond the sheet on its narrowest side: corners must be seen on all sides."""
    rims = (
        -origin_mm[0],
        -origin_mm[1],
        origin_mm[0] + board_mm[0] - sheet_mm[0],
        origin_mm[1] + board_mm[1] - sheet_mm[1],
    )
    remedy = "The sheet lies in the middle of a board that is larger than it: print a larger one, or teach the sheet."
    return within("board around the sheet", min(rims), 8.0, math.inf, "mm", remedy)


def touch_height(points: int, method: str) -> Check:
    """How the height of the paper is known."""
    if method == "taught":
        remedy = "Touch three points by force, camera or jog: [touch]."
        return unmeasured("height of the paper", "taught by hand", remedy)
    if points < 3:
        remedy = "Three touch.points_mm far apart would give the slope of the sheet."
        return unmeasured("slope of the sheet", f"{points} touch points: taken as level", remedy)
    return Check("height of the paper", "plausible", f"measured by {method} at {points} points", "3 or more points")


# Places and limits

LOOSE_MM = 250.0
"""Room beyond the outermost place, in mm, from which on the box no longer protects anything."""
PARK_CLEAR_MM = 40.0
"""Half the width of a holder and a part of the wrist, which must be out of the picture."""


def in_box(places: Sequence[Place], box_mm: Box) -> list[Check]:
    """Distance of the places from the walls of the box, each at its lowest and its highest point."""
    remedy = "Outside the box of limits: brushloop rig teach limits, or correct the place."
    return _worst(
        "inside the box",
        [within(f"inside the box, {p.name}", _inside_mm(p, box_mm), 0.0, math.inf, "mm", remedy) for p in places],
        min(places, key=lambda p: _inside_mm(p, box_mm)),
    )


def _inside_mm(place: Place, box_mm: Box) -> float:
    ends = (place.at_mm, (place.at_mm[0], place.at_mm[1], place.top_mm))
    return min(min(v - low, high - v) for end in ends for v, (low, high) in zip(end, box_mm, strict=True))


def _worst(name: str, checks: list[Check], worst: Place) -> list[Check]:
    """The checks that fail; if none does, the one with the least margin, as one check of all places."""
    if wrong := [check for check in checks if check.verdict == "contradicts"]:
        return wrong
    [tightest] = [check for check in checks if check.name.endswith(f", {worst.name}")]
    value = f"{tightest.value}, {worst.name}"
    return [dataclasses.replace(tightest, name=f"{name}, {len(checks)} places", value=value)]


def box_not_loose(places: Sequence[Place], box_mm: Box) -> Check:
    """Distance by which the box extends beyond all places that the tip goes to."""
    ends = [p.at_mm for p in places] + [(p.at_mm[0], p.at_mm[1], p.top_mm) for p in places]
    room_mm = max(
        max(min(along) - low, high - max(along))
        for along, (low, high) in zip(zip(*ends, strict=True), box_mm, strict=True)
    )
    remedy = "The box should enclose what was taught and little more: brushloop rig teach limits."
    return within("room in the box", room_mm, 0.0, LOOSE_MM, "mm", remedy)


def park_off_the_board(
    park_mm: tuple[float, float], board_mm: tuple[float, float], origin_mm: tuple[float, float]
) -> Check:
    """Distance of the parked tip from the board, seen from above; all in the paper frame."""
    outside = [max(low - v, v - low - size, 0.0) for v, low, size in zip(park_mm, origin_mm, board_mm, strict=True)]
    remedy = "The parked arm stands over the board, in the picture: brushloop rig teach places."
    return within("park beside the board", math.hypot(*outside), PARK_CLEAR_MM, math.inf, "mm", remedy)


def travel_over_rim(safe_z_mm: float, rim_z_mm: float) -> Check:
    """Height of travel above the rim of the well or the pot."""
    remedy = "Raise motion.safe_z_mm: a drop, or a tip bent by its ink, would catch the rim."
    return within("travel above the rim", safe_z_mm - rim_z_mm, 15.0, math.inf, "mm", remedy)


def dip_depth(dip_z_mm: float, touch_z_mm: float) -> Check:
    """Bottom of a dip relative to the paper: a well stands on the same table as the sheet."""
    remedy = "The bottom of a dip is far from the table: teach the well again."
    return within("dip above the paper", dip_z_mm - touch_z_mm, -60.0, 120.0, "mm", remedy)


# Force


def force_ceiling(max_n: float) -> Check:
    """Force above which the arm is stopped."""
    remedy = "A soft brush pushes with less than 3 N when it is pressed flat: force.max_n."
    return within("force ceiling", max_n, 0.2, 30.0, "N", remedy)


def push_direction(axis: tuple[float, float, float]) -> Check:
    """Angle from the tool's axis to the direction in which the sensor feels the paper push."""
    length = math.hypot(*axis)
    off_deg = math.degrees(math.acos(min(abs(axis[2]) / length, 1.0)))
    remedy = "The paper pushes along the tool: brushloop rig teach force finds axis and sign by a push."
    return within("push axis", off_deg, 0.0, 20.0, "deg", remedy)
