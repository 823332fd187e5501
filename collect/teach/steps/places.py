"""Step 5: well, wipe, pot of water and park position, taught by going there."""

from __future__ import annotations

import base64
import math

import cv2
import numpy as np

from brushloop.collect.errors import CannotTeach
from brushloop.collect.photograph.frames import ARM_SHARE, Thumbnail, changed_share, thumbnail
from brushloop.collect.rig.config import TRAVEL_CLEARANCE_MM, PaperConfig
from brushloop.collect.rig.paper import to_base, to_paper
from brushloop.collect.teach.arm_reader import ArmReader
from brushloop.collect.teach.cameras import side_by_side, still, taught_camera
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.guide import Target, TargetKind
from brushloop.collect.teach.jog import touch
from brushloop.collect.teach.maths.sheet import Point, corners_of
from brushloop.collect.teach.maths.tip import tip_of
from brushloop.collect.teach.store import Notebook, StepName, Taught, Value, now_utc

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
VIEW: dict[TargetKind, str] = {"park": "aside.view_parked", "clear-view": "aside.view_elsewhere"}
"""The small picture that was taken with the arm there."""


class PlacesStep(Step):
    """Where ink, water and rest are, and how high the arm travels between them."""

    name: StepName = "places"
    title = "Well, wash and park"
    minutes = 5
    needs: tuple[StepName, ...] = ("camera", "tip", "sheet")

    async def teach(self, day: Day) -> None:
        """Have the tip brought to each place; look whether the parked arm is out of the picture."""
        async with day.arm() as reader:
            await touch(day, reader, Target("well-rim"), "Bring the tip to the rim of the ink well.", "well-rim 0")
            how = "Bring the tip into the middle of the well, as deep as a dip should go: a few mm above its bottom."
            await touch(day, reader, Target("well"), how, "well 0")
            with day.touched_again_if_refused("well-rim", "well"):
                found = check_pot(day.notebook, "well-rim 0", "well 0", "well")
            await day.say(found)
            await self._wipe(day, reader)
            await self._wash(day, reader)
            how = "Guide the arm to any place out of the camera's picture."
            await self._out_of_picture(day, reader, Target("clear-view"), how)
            # Last, because the runs of the proof begin where the arm is left: it has to be within the limits.
            how = (
                "Now bring the arm to its waiting place: brush upright, above everything, out of the camera's picture, "
                f"{APART_MM:g} mm or more from there: two pictures that agree show the arm in neither."
            )
            await self._out_of_picture(day, reader, Target("park"), how)
            await self._compare(day)

    async def _wipe(self, day: Day, reader: ArmReader) -> None:
        """Have the side of the rim touched at which a drop is wiped off, if there is to be a wipe."""
        if "aside.wipe" in day.notebook.values:
            return
        wipe = "well-rim 1" in day.notebook.touches or await day.yes(
            "Shall each dip end with a wipe across the rim of the well, which takes the drop off?"
        )
        if wipe:
            how = "Bring the tip to the rim on the side where the drop shall be wiped off: the one away from the sheet."
            wipe = await touch(day, reader, Target("well-rim", 1, may_skip=True), how, "well-rim 1") is not None
        if wipe:
            with day.touched_again_if_refused("well-rim 1"):
                check_wipe(day.notebook)
        day.keep("places", "aside.wipe", wipe, "answered")

    async def _wash(self, day: Day, reader: ArmReader) -> None:
        """Have rim and middle of a pot of water touched, if there is one."""
        if "aside.wash" in day.notebook.values:
            return
        wash = "wash-rim 0" in day.notebook.touches or await day.yes("Is there a pot of water to wash the brush in?")
        if wash:
            await touch(day, reader, Target("wash-rim"), "Bring the tip to the rim of the pot of water.", "wash-rim 0")
            how = "Bring the tip into the middle of the pot of water, as deep as a wash should go."
            await touch(day, reader, Target("wash-pot"), how, "wash-pot 0")
            with day.touched_again_if_refused("wash-rim", "wash-pot"):
                check_pot(day.notebook, "wash-rim 0", "wash-pot 0", "pot of water")
        day.keep("places", "aside.wash", wash, "answered")

    async def _out_of_picture(self, day: Day, reader: ArmReader, target: Target, how: str) -> None:
        """Have the arm brought out of the picture, and keep pose and picture together: one says nothing alone."""
        if VIEW[target.kind] not in day.notebook.values:
            with day.together():
                day.save(day.notebook.without_touches(target.kind))
                await touch(day, reader, target, how, f"{target.kind} 0")
                await day.working("waiting for a picture without the arm")
                async with taught_camera(day.notebook, day.clock) as camera:
                    picture = thumbnail(await still(camera, day.clock))
                day.keep("places", VIEW[target.kind], text_of(picture), "a small picture, as PNG in base64")

    async def _compare(self, day: Day) -> None:
        """Compare the two pictures. Raises `CannotTeach` unless they show the same, with the arm at two places."""
        offset_mm, touches = day.notebook.numbers("robot.tcp_offset_mm"), day.notebook.touches
        parked_mm, away_mm = (tip_of(touches[f"{kind} 0"].pose(), offset_mm) for kind in ("park", "clear-view"))
        if (apart_mm := math.dist(parked_mm, away_mm)) < APART_MM:
            day.save(without_views(day.notebook, "park", "clear-view"))
            raise CannotTeach(
                f"the arm was only {apart_mm:.0f} mm apart in the two pictures: they show the same.",
                f"Bring it to two places {APART_MM:g} mm or more apart; both are asked again.",
            )
        pictures = [picture_of(str(day.notebook.get(VIEW[kind]))) for kind in ("park", "clear-view")]
        share = changed_share(*pictures)
        if share >= ARM_SHARE:
            beside = side_by_side([picture.astype(np.uint8) for picture in pictures])
            await day.say("The arm parked (1), and elsewhere (2):", picture=beside)
            day.save(without_views(day.notebook, "park", "clear-view"))
            raise CannotTeach(
                f"the arm, or its shadow, is in one of the two pictures: {100 * share:.0f} % of them differs.",
                "Park it farther from the sheet, or higher; both places are asked again.",
            )
        await day.say(f"With the arm at both places {100 * share:.1f} % of the picture differs: it is out of both.")

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Places in the sheet's frame, and the travel height."""
        paper, places = paper_of(notebook), tips(notebook)
        x, y, dip_z_mm = places["well 0"]
        rim_x, rim_y, _ = places["well-rim 0"]
        rim_z_mm = max(z for name, (_, _, z) in places.items() if name.startswith("well-rim "))
        highest_rim_mm = max(z for name, (_, _, z) in places.items() if name.split(" ")[0] in ("well-rim", "wash-rim"))
        safe_mm = max(max(sheet_heights(notebook)) + TRAVEL_MM, highest_rim_mm + RIM_CLEAR_MM)
        by_hand = "the tip was brought there by hand"

        def taught(value: Value, how: str = by_hand, known: str = "one touch by hand, within a mm") -> Taught:
            return Taught(value=value, unit="mm", how=how, known=known, at=now_utc(), step="places")

        park_x, park_y, park_z = places["park 0"]
        found = {
            "ink.well_mm": taught(list(to_paper(paper, x, y))),
            "ink.dip_z_mm": taught(dip_z_mm),
            "aside.well_radius_mm": taught(math.dist((x, y), (rim_x, rim_y))),
            "aside.rim_z_mm": taught(rim_z_mm),
            "motion.safe_z_mm": taught(
                safe_mm,
                f"the higher of sheet + {TRAVEL_MM:g} mm and highest rim + {RIM_CLEAR_MM:g} mm",
                "a stated clearance",
            ),
            "motion.park_mm": taught(
                [park_x, park_y, max(park_z, safe_mm)],
                by_hand + ("" if park_z >= safe_mm else ", and lifted to travel height"),
            ),
        }
        if "well-rim 1" in places:
            end, z_mm = wipe_of(notebook)
            how = f"{WIPE_PAST_MM:g} mm beyond the rim, which was touched there by hand"
            found["ink.wipe.rim_mm"] = taught(list(end), how)
            found["ink.wipe.z_mm"] = taught(z_mm, f"{WIPE_BELOW_MM:g} mm below the rim, which was touched by hand")
        if "wash-pot 0" in places:
            wash_x, wash_y, wash_z = places["wash-pot 0"]
            found["ink.wash.pot_mm"] = taught(list(to_paper(paper, wash_x, wash_y)))
            found["ink.wash.dip_z_mm"] = taught(wash_z)
        return found

    def forget(self, notebook: Notebook) -> Notebook:
        """Without what was touched here."""
        cleared = notebook.without("aside.wipe", "ink.wipe.", "aside.wash", "ink.wash.")
        return without_views(cleared.without_touches("well-rim", "well", "wash-rim", "wash-pot"), "park", "clear-view")

    def summary(self, notebook: Notebook) -> str:
        """Well and park."""
        x, y = notebook.numbers("ink.well_mm")
        px, py, pz = notebook.numbers("motion.park_mm")
        return f"well ({x:.0f}, {y:.0f}) mm on the sheet's axes, park ({px:.0f}, {py:.0f}, {pz:.0f}) mm"


def tips(notebook: Notebook) -> dict[str, Point]:
    """The tip at everything that was touched, by name, in the base frame."""
    offset_mm = notebook.numbers("robot.tcp_offset_mm")
    return {name: tip_of(touch.pose(), offset_mm) for name, touch in notebook.touches.items()}


def paper_of(notebook: Notebook) -> PaperConfig:
    """The sheet as it was taught."""
    names = ("origin_mm", "yaw_deg", "touch_z_mm", "size_mm", "touch_point_mm")
    return PaperConfig.model_validate({"name": "sheet"} | {name: notebook.get(f"paper.{name}") for name in names})


def sheet_heights(notebook: Notebook) -> list[float]:
    """Touch height at the four corners of the sheet, in the base frame."""
    z0_mm, slope_x, slope_y = notebook.numbers("aside.plane")
    size_x_mm, size_y_mm = notebook.numbers("paper.size_mm")
    return [z0_mm + slope_x * x + slope_y * y for x, y in corners_of(size_x_mm, size_y_mm).tolist()]


def sheet_corners(notebook: Notebook) -> list[Point]:
    """The corners of the sheet in the base frame."""
    paper, heights = paper_of(notebook), sheet_heights(notebook)
    return [(*to_base(paper, x, y), z) for (x, y), z in zip(corners_of(*paper.size_mm).tolist(), heights, strict=True)]


def check_pot(notebook: Notebook, rim: str, middle: str, what: str) -> str:
    """Describe a well or pot by its two touches. Raises `CannotTeach` if rim and dip contradict each other."""
    (rim_x, rim_y, rim_z), (x, y, z) = tips(notebook)[rim], tips(notebook)[middle]
    radius_mm = math.dist((rim_x, rim_y), (x, y))
    if not LEAST_RADIUS_MM <= radius_mm <= MOST_RADIUS_MM:
        raise CannotTeach(
            f"the dip is {radius_mm:.0f} mm from the rim of the {what}, seen from above: no {what} is that wide.",
            f"Teach the {what} again: its rim, then its middle.",
        )
    if z >= rim_z:
        raise CannotTeach(f"the dip is no deeper than the rim of the {what}.", "Bring the tip below the rim.")
    return f"{what} of radius {radius_mm:.0f} mm, its rim {rim_z - z:.1f} mm above the bottom of a dip"


def wipe_of(notebook: Notebook) -> tuple[tuple[float, float], float]:
    """Where a wipe from the middle of the well ends, in the paper frame, and the height of the tip during it."""
    (x, y, _), (rim_x, rim_y, rim_z) = tips(notebook)["well 0"], tips(notebook)["well-rim 1"]
    longer = 1.0 + WIPE_PAST_MM / max(math.dist((x, y), (rim_x, rim_y)), 1e-9)
    end = to_paper(paper_of(notebook), x + longer * (rim_x - x), y + longer * (rim_y - y))
    return end, rim_z - WIPE_BELOW_MM


def check_wipe(notebook: Notebook) -> None:
    """Raise `CannotTeach` for a wipe that leads over the sheet, or that begins elsewhere than in the well."""
    (x, y), z_mm = wipe_of(notebook)
    (well_x, well_y, dip_z), (rim_x, rim_y, _) = tips(notebook)["well 0"], tips(notebook)["well-rim 1"]
    radius_mm = math.dist((well_x, well_y), (rim_x, rim_y))
    width, height = notebook.numbers("paper.size_mm")
    if not LEAST_RADIUS_MM <= radius_mm <= MOST_RADIUS_MM or z_mm <= dip_z:
        raise CannotTeach(
            f"that place is {radius_mm:.0f} mm from the middle of the well and {z_mm - dip_z:+.1f} mm above the "
            "bottom of a dip: no rim can be there.",
            "Touch the rim of the same well; only this place is asked again.",
        )
    if 0.0 <= x <= width and 0.0 <= y <= height:
        raise CannotTeach(
            "the wipe would end over the sheet, and the drop would fall on it.",
            "Touch the rim on another side; only this place is asked again.",
        )


def without_views(notebook: Notebook, *kinds: TargetKind) -> Notebook:
    """The notebook without the arm at these places, and without the pictures from there."""
    return notebook.without_touches(*kinds).without(*(VIEW[kind] for kind in kinds))


def text_of(picture: Thumbnail) -> str:
    """A small picture as PNG in base64."""
    return base64.b64encode(cv2.imencode(".png", picture.astype(np.uint8))[1].tobytes()).decode()


def picture_of(text: str) -> Thumbnail:
    """The picture again."""
    coded = np.frombuffer(base64.b64decode(text), np.uint8)
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.float32)
