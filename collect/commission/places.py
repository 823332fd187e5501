"""Steps 5 and 8: well, wipe, pot of water and park position, taught by going there; and the smallest box around all."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence

import numpy as np

from brushloop.calibrate.files import read_gray
from brushloop.collect.commission.arm import Point, tips, touch
from brushloop.collect.commission.camera import opened, shown_live, still
from brushloop.collect.commission.sheet import corners_of
from brushloop.collect.commission.visit import NO, YES, Notebook, Step, Taught, Visit, choice_of, number_of, rig_of
from brushloop.collect.errors import ConfigError, NotAccepted
from brushloop.collect.photograph.frames import ARM_SHARE, Thumbnail, changed_share, thumbnail
from brushloop.collect.rig.check import draw_rig, places_of
from brushloop.collect.rig.config import TRAVEL_CLEARANCE_MM, PaperConfig, RigConfig
from brushloop.collect.rig.paper import PaperPlane, to_base, to_paper
from brushloop.collect.walk import ask_reach
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose

TRAVEL_MM = 60.0
"""Travel height above the highest corner of the sheet: room for a dry run 30 mm above it."""
RIM_CLEAR_MM = TRAVEL_CLEARANCE_MM + 5.0
"""Travel height above the rim of any pot: a drop hangs from the tip."""
WIPE_PAST_MM, WIPE_BELOW_MM = 6.0, 1.5
"""A wipe ends so far beyond the rim, with the tip so far below it: the hair is drawn over the rim."""
LEAST_RADIUS_MM, MOST_RADIUS_MM = 5.0, 100.0
"""From the rim of a well to its middle."""
APART_MM = 150.0
"""Between two places of the arm: farther apart, no part of it that is in both pictures hides the same in both."""
AWAY = {
    "clear-view": "Guide the arm to any place out of the camera's picture.",
    # Last, because the runs of the proof begin where the arm is left: it has to be within the limits.
    "park": "Now bring the arm to its waiting place: brush upright, above everything, out of the camera's picture, and "
    f"{APART_MM:g} mm or more from the last place. A picture is taken at both places; neither may show the arm.",
}
PARKED = "aside.parked"
INK = ("well-rim", "well", "wash-rim", "wash-pot")
WIPE = choice_of("Shall each dip end with a wipe across the rim of the well, so that no drop falls?", (YES, NO))
WASH = choice_of("Is there a pot of water to wash the brush in?", (YES, NO))
MARGIN_MM = 25.0
"""Room beside what was taught: a brush lifted along a tool axis that leans by 15 deg moves aside by as much."""
BELOW_MM = 2.0
"""Room below the deepest press and the dip, for a sheet that is found a little lower."""
BOX = tuple(f"robot.limits.{axis}_mm" for axis in "xyz")
SPEEDS = {
    "robot.limits.tilt_deg": number_of("Largest tilt of the brush", 1.0, 30.0, "deg", "15"),
    "robot.limits.speed_mm_s": number_of("Highest speed of the tip in later sessions", 1.0, 500.0, "mm/s", "150"),
    "robot.limits.acc_mm_s2": number_of("Highest acceleration in any motion", 1.0, 5000.0, "mm/s2", "800"),
    "motion.travel_speed_mm_s": number_of("Speed of travel above the sheet", 1.0, 500.0, "mm/s", "100"),
    "motion.press_speed_mm_s": number_of("Speed of the descent into a press", 1.0, 100.0, "mm/s", "15"),
    "motion.acc_mm_s2": number_of("Acceleration in travel and press", 1.0, 5000.0, "mm/s2", "500"),
}
"""With cautious defaults, and the most that `rig.toml` takes."""


class PlacesStep(Step):
    """Where ink, water and rest are, and how high the arm travels between them."""

    name = "places"
    title = "Well, wash and park"
    minutes = 5
    observes = (*INK, *AWAY, "aside.wipe", "ink.wipe.", "aside.wash", "ink.wash.", PARKED)

    async def carry_out(self, visit: Visit) -> None:
        """Have the tip brought to each place; look whether the parked arm is out of the picture."""
        await touch(visit, "well-rim 0", "Bring the tip to the rim of the ink well.")
        how = "Bring the tip into the middle of the well, as deep as a dip should go: a few mm above its bottom."
        await touch(visit, "well 0", how)
        with visit.asked_again_if_refused("well-rim", "well"):
            check_pot(visit.notebook, "well-rim 0", "well 0", "well")
        if await visit.value("aside.wipe", WIPE) == YES.key:
            how = "Bring the tip to the rim of the well where the drop shall be wiped off, away from the sheet."
            await touch(visit, "well-rim 1", how)
            with visit.asked_again_if_refused("well-rim 1"):
                check_wipe(visit.notebook)
        if await visit.value("aside.wash", WASH) == YES.key:
            await touch(visit, "wash-rim 0", "Bring the tip to the rim of the pot of water.")
            how = "Bring the tip into the middle of the pot of water, as deep as a wash should go."
            await touch(visit, "wash-pot 0", how)
            with visit.asked_again_if_refused("wash-rim", "wash-pot"):
                check_pot(visit.notebook, "wash-rim 0", "wash-pot 0", "pot of water")
        if PARKED not in visit.notebook.values:
            await self._park(visit)

    async def _park(self, visit: Visit) -> None:
        """Have the arm brought out of the picture, to two places.

        Raises `NotAccepted` unless the pictures from there show the same.
        """
        # One place alone may be left, after going back or a power cut: its picture needs the arm there again.
        visit.forget(*AWAY)
        pictures: list[Thumbnail] = []
        async with opened(visit) as camera:
            for kind, how in AWAY.items():
                async with shown_live(visit, camera):
                    await touch(visit, f"{kind} 0", how)
                visit.working("waiting for a picture without the arm")
                pictures.append(thumbnail(await still(camera, visit.clock)))
        places = tips(visit.notebook)
        if (apart_mm := math.dist(places["park 0"], places["clear-view 0"])) < APART_MM:
            raise NotAccepted(
                f"the two places are only {apart_mm:.0f} mm apart: an arm in both pictures would go unnoticed.",
                f"Bring the arm to two places {APART_MM:g} mm or more apart; you are asked for both again.",
            )
        share = changed_share(*pictures)
        if share >= ARM_SHARE:
            visit.say("The arm elsewhere (left), and parked (right):", picture=np.hstack(pictures).astype(np.uint8))
            raise NotAccepted(
                f"the arm, or its shadow, is in one of the two pictures: {100 * share:.0f} % of the pixels differ.",
                "Park the arm farther from the sheet, or higher; you are asked for both places again.",
            )
        shown = f"the two pictures agree ({100 * share:.1f} % of the pixels differ): the arm is in neither"
        visit.keep({PARKED: Taught(True, shown)})
        visit.say(f"{shown.capitalize()}.")

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Places in the sheet's frame, and the travel height."""
        paper, places = paper_of(notebook), tips(notebook)
        x, y, dip_z_mm = places["well 0"]
        highest_rim_mm = max(z for name, (_, _, z) in places.items() if name.split(" ")[0] in ("well-rim", "wash-rim"))
        highest_mm = max(z for _, _, z in sheet_corners(notebook))
        safe_mm = max(highest_mm + TRAVEL_MM, highest_rim_mm + RIM_CLEAR_MM)
        park_x, park_y, park_z = places["park 0"]
        by_hand = "the tip was brought there by hand"

        def at(value: float | list[float], how: str = by_hand, known: str = "one touch by hand, within a mm") -> Taught:
            return Taught(value, how, known=known)

        travel = f"the higher of sheet + {TRAVEL_MM:g} mm and highest rim + {RIM_CLEAR_MM:g} mm"
        lifted = "" if park_z >= safe_mm else ", and lifted to travel height"
        values = {
            "ink.well_mm": at(list(to_paper(paper, x, y))),
            "ink.dip_z_mm": at(dip_z_mm),
            "motion.safe_z_mm": at(safe_mm, travel, "a chosen clearance"),
            "motion.park_mm": at([park_x, park_y, max(park_z, safe_mm)], by_hand + lifted),
        }
        if "well-rim 1" in places:
            end, z_mm = wipe_of(notebook)
            how = f"{WIPE_PAST_MM:g} mm beyond the rim, which was touched there by hand"
            values["ink.wipe.rim_mm"] = at(list(end), how)
            values["ink.wipe.z_mm"] = at(z_mm, f"{WIPE_BELOW_MM:g} mm below the rim, which was touched by hand")
        if "wash-pot 0" in places:
            wash_x, wash_y, wash_z = places["wash-pot 0"]
            values["ink.wash.pot_mm"] = at(list(to_paper(paper, wash_x, wash_y)))
            values["ink.wash.dip_z_mm"] = at(wash_z)
        return values


def paper_of(notebook: Notebook) -> PaperConfig:
    """The sheet as it was taught."""
    return PaperConfig.model_validate(notebook.table("paper."))


def sheet_corners(notebook: Notebook) -> list[Point]:
    """The corners of the sheet in the base frame, at touch height."""
    paper, plane = paper_of(notebook), PaperPlane(*notebook.get("aside.plane"))
    return [(*to_base(paper, x, y), plane.touch_z_mm(x, y)) for x, y in corners_of(*paper.size_mm).tolist()]


def check_pot(notebook: Notebook, rim: str, middle: str, what: str, way_out: str = "") -> None:
    """Raise `NotAccepted` if rim and dip of a well or a pot contradict each other."""
    (rim_x, rim_y, rim_z), (x, y, z) = tips(notebook)[rim], tips(notebook)[middle]
    radius_mm = math.dist((rim_x, rim_y), (x, y))
    way_out = way_out or f"Teach the {what} again: its rim, then its middle."
    if not LEAST_RADIUS_MM <= radius_mm <= MOST_RADIUS_MM:
        raise NotAccepted(
            f"the dip is {radius_mm:.0f} mm from the rim of the {what}, seen from above: no {what} is that wide.",
            way_out,
        )
    if z >= rim_z - WIPE_BELOW_MM:
        raise NotAccepted(f"the dip is no deeper than the rim of the {what}.", way_out)


def wipe_of(notebook: Notebook) -> tuple[tuple[float, float], float]:
    """Where a wipe from the middle of the well ends, in the paper frame, and the height of the tip during it."""
    (x, y, _), (rim_x, rim_y, rim_z) = tips(notebook)["well 0"], tips(notebook)["well-rim 1"]
    longer = 1.0 + WIPE_PAST_MM / max(math.dist((x, y), (rim_x, rim_y)), 1e-9)
    end = to_paper(paper_of(notebook), x + longer * (rim_x - x), y + longer * (rim_y - y))
    return end, rim_z - WIPE_BELOW_MM


def check_wipe(notebook: Notebook) -> None:
    """Raise `NotAccepted` for a wipe that leads over the sheet, or that begins elsewhere than in the well."""
    check_pot(notebook, "well-rim 1", "well 0", "well", "Touch the rim of the same well; only this touch is repeated.")
    (x, y), _ = wipe_of(notebook)
    width, height = notebook.get("paper.size_mm")
    if 0.0 <= x <= width and 0.0 <= y <= height:
        raise NotAccepted(
            "the wipe would end over the sheet, and the drop would fall on it.",
            "Touch the rim on another side; only this touch is repeated.",
        )


class LimitsStep(Step):
    """Box, cone and speeds."""

    name = "limits"
    title = "Limits"
    minutes = 3
    observes = tuple(SPEEDS)

    async def carry_out(self, visit: Visit) -> None:
        """Have each limit and the box confirmed, and ask the controller whether the arm reaches every corner."""
        for field, prompt in SPEEDS.items():
            await visit.value(field, prompt)
        box = self.derived(visit.notebook)
        rig = rig_of(visit.notebook.with_values(box), visit.rig_path)
        picture = visit.rig_path.with_name(f"{visit.rig_path.stem}.limits.png")
        visit.working("drawing box and places")
        await asyncio.to_thread(draw_rig, rig, picture)
        visit.say(
            f"{picture} shows limits, sheet, board, well and park position from above.",
            picture=await asyncio.to_thread(read_gray, picture),
        )
        x_mm, y_mm, z_mm = (f"{taught.value} mm" for taught in box.values())
        if not await visit.yes(
            f"The tip will stay in this box of the base frame: x {x_mm}, y {y_mm}, z {z_mm}. It is the smallest "
            f"box around sheet, well, wipe, pot and park position, with {MARGIN_MM:g} mm beside and above them, and "
            f"{BELOW_MM:g} mm below the deepest press and the dip. Agreed?"
        ):
            raise NotAccepted(
                "the box was refused.", "Teach the place again that makes the box too large: `brushloop rig teach`."
            )
        try:
            count = await ask_reach(visit.rig_path, rig, _to_reach(rig))
        except ConfigError as error:
            raise NotAccepted(
                f"the arm does not reach the whole sheet: {error.what}.",
                "Move the board with the sheet nearer to the arm, and teach sheet and places again.",
            ) from None
        visit.say(f"The controller finds joint angles for all {count} poses at the places of the tip and above them.")

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """The smallest box around everything that the tip must reach, in the base frame."""
        places, corners = tips(notebook), sheet_corners(notebook)
        x, y, lowest_mm = min(corners, key=lambda corner: corner[2])
        heights_mm = (
            notebook.get("motion.safe_z_mm"),
            lowest_mm - notebook.get("brush.max_depth_mm") - BELOW_MM,
            notebook.get("ink.dip_z_mm") - BELOW_MM,
        )
        park_x, park_y, park_z = notebook.get("motion.park_mm")
        reached = [point for name, point in places.items() if name.split(" ")[0] in INK]
        points = [*reached, (park_x, park_y, park_z), *corners, *((x, y, z) for z in heights_mm)]
        beside = f"{MARGIN_MM:g} mm around the smallest box that holds sheet, well, wipe, pot and park position"
        floor = f"{BELOW_MM:g} mm below the deepest press and the dip; {MARGIN_MM:g} mm above travel and park heights"
        ranges = zip(BOX, hull(points, MARGIN_MM), (beside, beside, floor), strict=True)
        return {field: Taught(range_mm, how) for field, range_mm, how in ranges}


def hull(points: Sequence[Point], margin_mm: float) -> list[list[float]]:
    """Ranges of x, y and z around these points, widened by the margin in x and y, and upward in z; rounded outward."""
    low, high = np.min(points, axis=0), np.ceil(np.max(points, axis=0) + margin_mm)
    floors = [*np.floor(low[:2] - margin_mm), math.floor(10.0 * low[2]) / 10.0]
    return [[float(least), float(most)] for least, most in zip(floors, high, strict=True)]


def _to_reach(rig: RigConfig) -> list[tuple[Pose, float, str]]:
    """Every place of the tip, at travel height and at its lowest; pressed into the sheet, the brush leans to the cone's
    edge."""
    yaw_deg, speed_mm_s, poses = rig.paper.yaw_deg, rig.motion.press_speed_mm_s, list[tuple[Pose, float, str]]()
    for name, (x, y, z) in places_of(rig).items():
        over = brush_pose(x, y, max(z, rig.motion.safe_z_mm), heading_deg=yaw_deg)
        tilt_deg = rig.robot.limits.tilt_deg if name.startswith("sheet") else 0.0
        at = brush_pose(x, y, z, heading_deg=yaw_deg, tilt_deg=tilt_deg)
        poses += [(over, speed_mm_s, f"over {name}"), (at, speed_mm_s, f"at {name}")]
    return poses
