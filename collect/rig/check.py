"""One page about a `rig.toml`: values that are plausible, contradict each other or are unmeasured. Asks no device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from rich.text import Text

from brushloop.calibrate.board.spec import size_mm
from brushloop.collect.rig import plausible
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.config_devices import CameraConfig
from brushloop.collect.rig.devices import limits_of
from brushloop.collect.rig.paper import Sheet, to_paper
from brushloop.collect.rig.places import places_of
from brushloop.collect.rig.plausible import Check, unmeasured, within

COLOURS = {"plausible": "green", "contradicts": "red", "not measured": "yellow"}


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
    offset_mm, brush = config.robot.tcp_offset_mm, config.brush
    yield plausible.tool_length(offset_mm)
    yield plausible.brush_square(config.robot.tcp_rotation_deg)
    yield plausible.brush_shorter_than_tool(offset_mm, brush.length_mm)
    yield plausible.deepest_press(brush.max_depth_mm, brush.length_mm)
    yield plausible.payload(config.robot.payload_kg)
    if config.robot.collision_level is None:
        yield unmeasured("collision level", "the pendant's", "robot.collision_level fixes it; 9 is the most sensitive.")


def _camera(camera: CameraConfig) -> Iterator[Check]:
    locked = camera.locked
    streamed = "://" in camera.source
    names = [name for name, value in locked.model_dump().items() if value is None]
    if streamed:
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
    paper, board = config.paper, config.board
    yield plausible.square_size(board.square_mm)
    yield plausible.board_rim(size_mm(board), board.origin_mm, paper.size_mm)
    patches = Sheet(paper).capacity
    yield within("patches on a sheet", patches, 1, float("inf"), "", "paper.cell_mm does not fit on paper.size_mm.")
    yield plausible.touch_height(len(config.touch.points_mm) or 1, config.touch.method)
    if config.self_check.enabled is False:
        remedy = "Three marks before a session show a mirrored or turned sheet: [self_check] enabled."
        yield unmeasured("self-check", "switched off", remedy)


def _ink(config: RigConfig) -> Iterator[Check]:
    ink, motion = config.ink, config.motion
    yield plausible.dip_depth(ink.dip_z_mm, config.paper.touch_z_mm)
    if ink.wipe is not None:
        yield plausible.travel_over_rim(motion.safe_z_mm, ink.wipe.z_mm)
    else:
        yield unmeasured("rim of the well", "no [ink.wipe]", "The height of the rim is unknown: travel must clear it.")


def _places(config: RigConfig) -> Iterator[Check]:
    limits, places = limits_of(config), places_of(config)
    box_mm = (limits.x_mm, limits.y_mm, limits.z_mm)
    yield from plausible.in_box(places, box_mm)
    yield plausible.box_not_loose(places, box_mm)
    park = to_paper(config.paper, *config.motion.park_mm[:2])
    yield plausible.park_off_the_board(park, size_mm(config.board), config.board.origin_mm)


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
    yield plausible.force_ceiling(config.force.max_n)
    if config.touch.method == "force":
        yield plausible.push_direction(config.touch.force.push_axis)


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
    page.append(", ".join(f"{counts[verdict]} {verdict}" for verdict in COLOURS))
    return page
